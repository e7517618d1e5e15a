// What a person says about takes, and taking it back. Every edit is a line with author and time in the studio.

import * as format from "./format.js";

const MOST = 1000; // takes in one request
const NAME = "studio.author";

// {outcome: "success"} of one take or many, signed; `done` hears the rows that came of it.
export class Edits {
  known = ""; // the name under which the studio knows this person
  #api; #done;
  #undoable = []; // {words, undo}, the oldest first
  #last = Promise.resolve(); // one after the other: who undoes at once means what was just asked for

  constructor(api, done) {
    [this.#api, this.#done] = [api, done];
  }

  get author() { return localStorage.getItem(NAME) || this.known || "guest"; }
  set author(name) { localStorage.setItem(NAME, name.trim()); }

  // What the next undo takes back, in words; null where there is nothing.
  get undoable() { return this.#undoable.at(-1)?.words ?? null; }

  // Say something about some takes; `words` tell people what. Each thousand of takes all or none.
  say(ids, changes, words) {
    const edit = { author: this.author, edit_id: newId(), ...changes };
    return this.#inTurn(async () => {
      const rows = await this.#post(ids, edit);
      this.remember(words, () => this.#post(ids, { author: edit.author, undo: edit.edit_id }));
      return rows;
    });
  }

  // Move takes to the trash, one by one. Those that cannot go are told in the end.
  remove(rows, isInsisting = false) {
    return this.#inTurn(async () => {
      const { gone, refused } = await this.#remove(rows, isInsisting);
      if (gone.length) this.remember(`${subject(gone)} deleted`, () => this.#restore(gone));
      return { gone, refused };
    });
  }

  restore(rows) {
    return this.#inTurn(async () => {
      await this.#restore(rows);
      this.remember(`${subject(rows)} restored`, () => this.#remove(rows, false));
    });
  }

  // What was done, and how it is undone.
  remember(words, undo) {
    this.#undoable.push({ words, undo });
  }

  // Take back what was done last on this page; what it was, or null.
  undo() {
    return this.#inTurn(async () => {
      const last = this.#undoable.pop();
      if (!last) return null;
      try {
        await last.undo();
      } catch (error) {
        this.#undoable.push(last);
        throw error;
      }
      return last.words;
    });
  }

  #inTurn(act) {
    const turn = this.#last.then(act);
    this.#last = turn.catch(() => {});
    return turn;
  }

  async #remove(rows, isInsisting) {
    const [gone, refused] = [[], []];
    for (const row of rows) {
      try {
        await this.#api.del(`/episodes/${encodeURIComponent(row.episode_id)}`, { even_if_used: isInsisting });
        gone.push(row);
      } catch (error) {
        if (!error.status) throw error;
        refused.push({ row, error });
      }
    }
    if (gone.length) this.#done(gone, true);
    return { gone, refused };
  }

  async #restore(rows) {
    for (const row of rows) await this.#api.post(`/episodes/${encodeURIComponent(row.episode_id)}/restore`);
    this.#done(rows, true);
  }

  async #post(ids, edit) {
    const rows = [];
    for (let begin = 0; begin < ids.length; begin += MOST) {
      rows.push(...await this.#api.post("/annotations", { ...edit, episode_ids: ids.slice(begin, begin + MOST) }));
    }
    this.#done(rows, false);
    return rows;
  }
}

// One take by its name, several by their number.
export function subject(rows) {
  return rows.length === 1 ? format.name(rows[0]) : format.takes(rows.length);
}

function newId() {
  const bytes = crypto.getRandomValues(new Uint8Array(9)); // randomUUID exists under TLS only
  return btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_");
}
