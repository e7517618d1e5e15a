// The line above the table: search, what is asked for, how much that is; or what to do with what is selected.

import { h } from "./dom.js";
import { chips } from "./filters.js";
import * as format from "./format.js";

const TYPING = 200; // [ms] without a letter before the search is asked

export class Toolbar {
  #act; #search; #chips; #amount; #selection; #timer = 0; #author; #banner;

  // `act` has what the buttons do: filter, search, health, collect, help, sign, …
  constructor(container, act, author) {
    this.#act = act;
    this.#search = h("input", {
      type: "search", id: "search", placeholder: "Search notes, ids, people   /", "aria-label": "Search", autocomplete: "off",
      oninput: () => { clearTimeout(this.#timer); this.#timer = setTimeout(() => act.search(this.#search.value.trim()), TYPING); },
      onkeydown: (event) => {
        if (event.key === "Escape" || event.key === "Enter") { event.preventDefault(); event.stopPropagation(); act.leaveSearch(); }
      },
    });
    this.#chips = h("span", { class: "chips" });
    this.#amount = h("span", { class: "amount" });
    this.#author = h("button", { class: "author", title: "Your name, for what you say about takes", onclick: () => act.sign() }, author);
    this.#selection = h("div", { class: "selection", hidden: true });
    this.#banner = h("div", { class: "banner", hidden: true });
    container.append(
      h("div", { class: "tools" }, this.#selection,
        this.#search, this.#chips, this.#amount,
        h("span", { class: "buttons" },
          h("button", { onclick: () => act.health() }, "Health…"),
          h("button", { onclick: () => act.collect() }, "Collect…"),
          h("button", { class: "export", onclick: () => act.export() }, "Export…"),
          this.#author,
          h("button", { class: "help", title: "Keys (?)", "aria-label": "Keys", onclick: () => act.help() }, "?"))),
      this.#banner);
  }

  set author(name) { this.#author.textContent = name; }

  focusSearch() { this.#search.focus(); this.#search.select(); }

  show(filters, amount) {
    if (document.activeElement !== this.#search) this.#search.value = filters.text ?? "";
    this.#chips.replaceChildren(...chips(filters).filter(([words]) => !words.startsWith("“")).map(([words, rest]) => h("button", {
      class: "chip", title: "Take this filter off", onclick: () => this.#act.filter(rest),
    }, `${words} ×`)));
    const judged = amount.successes + amount.failures;
    this.#amount.replaceChildren(
      h("b", {}, format.count(amount.takes)), amount.takes === 1 ? " take" : " takes",
      h("span", {}, ` · ${format.hours(amount.seconds)}`),
      judged ? h("span", { title: `${amount.successes} of ${judged} judged takes` }, ` · ${format.percent(amount.successes / judged)} success`) : "");
  }

  // What the list is where it is not all takes; null for those.
  showBanner(content) {
    this.#banner.hidden = !content;
    this.#banner.replaceChildren(...(content ?? []));
  }

  showSelection(rows) {
    this.#selection.hidden = !rows.length;
    if (!rows.length) return;
    const act = this.#act;
    const button = (words, action, title = null) => h("button", { title, onclick: action }, words);
    this.#selection.replaceChildren(
      h("b", {}, `${format.count(rows.length)} selected`),
      button("✓ Success", () => act.outcome("success"), "S"), button("✗ Failure", () => act.outcome("failure"), "F"),
      button("○ Unmarked", () => act.outcome("unmarked"), "P"),
      h("span", { class: "rates", "aria-label": "Quality" }, [1, 2, 3, 4, 5].map((n) => button(`${n}`, () => act.rate(n), `Quality ${n}`))),
      button("Edit…", () => act.edit(), "E"),
      button("Collect…", () => act.collect(), "C"),
      rows.length > 1 && rows.length <= 8 ? button("Compare", () => act.compare()) : "",
      button("Export…", () => act.export()),
      h("button", { class: "danger", title: "Del", onclick: () => act.remove() }, "Delete"),
      h("button", { class: "clear", onclick: () => act.clear() }, "Clear"));
  }
}
