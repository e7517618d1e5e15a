// What a person says about takes, and taking it back. Every edit is a line with author and time in the studio.

import * as format from "./format.js";

const MOST = 1000; // takes in one request
const NAME = "studio.author";

// {outcome: "success"} of one take or many, signed; `done` hears the rows that came of it.
export class Edits {
  #api; #done; #undoable = []; // {words, undo}, the oldest first

  constructor(api, done) {
    [this.#api, this.#done] = [api, done];
  }

  get author() { return localStorage.getItem(NAME) || "guest"; }
  set author(name) { localStorage.setItem(NAME, name.trim()); }

  // What the next undo takes back, in words; null where there is nothing.
  get undoable() { return this.#undoable.at(-1)?.words ?? null; }

  // Say something about some takes; `words` tell people what. Each thousand of takes all or none.
  async say(ids, changes, words) {
    const edit = { author: this.author, edit_id: newId(), ...changes };
    const rows = await this.#post(ids, edit);
    this.remember(words, () => this.#post(ids, { author: this.author, undo: edit.edit_id }));
    return rows;
  }

  // Move takes to the trash, one by one. Those that cannot go are told in the end.
  async remove(rows, isInsisting = false) {
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
    if (gone.length) {
      this.remember(`${subject(gone)} deleted`, () => this.restore(gone, false));
      this.#done(gone, true);
    }
    return { gone, refused };
  }

  async restore(rows, isUndoable = true) {
    for (const row of rows) await this.#api.post(`/episodes/${encodeURIComponent(row.episode_id)}/restore`);
    if (isUndoable) this.remember(`${subject(rows)} restored`, () => this.#removeAgain(rows));
    this.#done(rows, true);
  }

  // What was done, and how it is undone.
  remember(words, undo) {
    this.#undoable.push({ words, undo });
  }

  // Take back what was done last on this page; what it was, or null.
  async undo() {
    const last = this.#undoable.pop();
    if (!last) return null;
    try {
      await last.undo();
    } catch (error) {
      this.#undoable.push(last);
      throw error;
    }
    return last.words;
  }

  async #removeAgain(rows) {
    for (const row of rows) await this.#api.del(`/episodes/${encodeURIComponent(row.episode_id)}`);
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
