// The takes that are asked for, by their place in the list: only what was looked at is here.

const PAGE = 100;
const REST = 40; // [ms] of scrolling less before pages are fetched

export class Rows {
  total = 0;
  source = { kind: "all" }; // or {kind: "trash"}, or {kind: "collection", name}
  query = { sort: "started", descending: true };
  #api; #onChange;
  #pages = new Map(); // number -> rows
  #whole = null; // the rows of what comes in one piece: the trash, a collection
  #wanted = new Set();
  #timer = 0;
  #turn = 0; // counts what was asked anew; answers of before are dropped
  #line = Promise.resolve(); // one request after the other: no old answer comes after a newer one

  constructor(api, onChange) {
    [this.#api, this.#onChange] = [api, onChange];
  }

  // The take at a place; undefined until it is here, which `onChange` tells.
  at(place) {
    if (this.#whole) return this.#whole[place];
    const number = Math.floor(place / PAGE);
    const page = this.#pages.get(number);
    if (!page && place < this.total) this.#want(number);
    return page?.[place % PAGE];
  }

  // All of them, where they come in one piece.
  get whole() { return this.#whole; }

  get amount() {
    const rows = this.#whole ?? [];
    const counted = (outcome) => rows.filter((row) => row.outcome === outcome).length;
    const seconds = rows.reduce((sum, row) => sum + row.duration, 0);
    return { takes: rows.length, seconds, successes: counted("success"), failures: counted("failure") };
  }

  // The place of a take among those that are here, else -1.
  placeOf(id) {
    if (this.#whole) return this.#whole.findIndex((row) => row.episode_id === id);
    for (const [number, page] of this.#pages) {
      const found = page.findIndex((row) => row.episode_id === id);
      if (found >= 0) return PAGE * number + found;
    }
    return -1;
  }

  // Takes as they are by now, where they are here.
  patch(rows) {
    for (const row of rows) {
      const place = this.placeOf(row.episode_id);
      if (place < 0) continue;
      if (this.#whole) this.#whole[place] = row;
      else this.#pages.get(Math.floor(place / PAGE))[place % PAGE] = row;
    }
    this.#onChange();
  }

  // Ask anew for the places `first` to `last` and that of the cursor, and forget the others. What is shown stays
  // until the answer.
  reload(first, last, cursor, unless) {
    const turn = ++this.#turn;
    return this.#inLine(() => turn === this.#turn && this.#reload(() => turn !== this.#turn || unless(), first, last, cursor));
  }

  // What others said about the takes that are here, without moving any of them.
  freshen(first, last) {
    const turn = this.#turn;
    return this.#inLine(() => turn === this.#turn && !this.#whole && this.#freshen(turn, first, last));
  }

  // The first of all that match, at most so many of them.
  async first(most) {
    if (this.#whole) return this.#whole.slice(0, most);
    const found = [];
    for (let offset = 0; offset < Math.min(this.total, most); offset += 1000) {
      const { episodes } = await this.#api.get("/episodes", { ...this.query, limit: Math.min(1000, most - offset), offset });
      found.push(...episodes);
    }
    return found;
  }

  #inLine(act) {
    const turn = this.#line.then(act);
    this.#line = turn.catch(() => {});
    return turn;
  }

  async #reload(isDropped, first, last, cursor) {
    if (this.source.kind !== "all") {
      const rows = sorted(await this.#fetchWhole(), this.query);
      if (isDropped()) return;
      [this.#whole, this.total] = [rows, rows.length];
    } else {
      const numbers = range(Math.floor(first / PAGE), Math.floor(Math.max(first, last - 1) / PAGE));
      if (!numbers.includes(Math.floor(cursor / PAGE))) numbers.push(Math.floor(cursor / PAGE));
      const answers = await Promise.all(numbers.map((number) => this.#fetch(number)));
      if (isDropped()) return;
      this.#whole = null;
      this.#pages = new Map(numbers.map((number, index) => [number, answers[index].episodes]));
      this.total = answers[0].total;
    }
    this.#onChange();
  }

  async #freshen(turn, first, last) {
    for (const number of range(Math.floor(first / PAGE), Math.floor(Math.max(first, last - 1) / PAGE))) {
      const { episodes } = await this.#fetch(number);
      if (turn !== this.#turn) return;
      this.patch(episodes);
    }
  }

  #want(number) {
    this.#wanted.add(number);
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#fetchWanted(), REST);
  }

  async #fetchWanted() {
    const [turn, numbers] = [this.#turn, [...this.#wanted].slice(-3)]; // the newest: others were scrolled past
    this.#wanted.clear();
    for (const number of numbers) {
      try {
        const { episodes } = await this.#fetch(number);
        if (turn !== this.#turn) return;
        this.#pages.set(number, episodes);
        this.#onChange();
      } catch {
        return; // the next look asks again
      }
    }
  }

  #fetch(number) {
    return this.#api.get("/episodes", { ...this.query, limit: PAGE, offset: PAGE * number });
  }

  #fetchWhole() {
    const { kind, name } = this.source;
    return this.#api.get(kind === "trash" ? "/trash" : `/collections/${encodeURIComponent(name)}/episodes`);
  }
}

function range(first, last) {
  return Array.from({ length: last - first + 1 }, (_, index) => first + index);
}

function sorted(rows, { sort, descending }) {
  const way = descending ? -1 : 1;
  const rank = (a, b) => (a === b ? 0 : a === null ? -1 : b === null ? 1 : a < b ? -1 : 1);
  return [...rows].sort((a, b) => way * rank(a[sort], b[sort]) || way * (a.started - b.started));
}
