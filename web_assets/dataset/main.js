// The dataset page: the takes of a data folder, and one of them in view.

import { api } from "./api.js";
import { attempt, h, toast } from "./dom.js";

const section = document.getElementById("episode");
const list = document.getElementById("takes");
let view = null;

async function viewOf() {
  if (view) return view;
  const { EpisodeView } = await import("../episode/view.js");
  view = new EpisodeView(section, { api, changed: () => load(), selected: () => [] });
  return view;
}

async function open(row) {
  section.hidden = false;
  try {
    (await viewOf()).open(row);
  } catch (error) {
    section.hidden = true;
    toast("A take cannot be shown here yet.");
  }
}

async function load() {
  const { total, episodes } = await api.get("/episodes", { limit: 100 });
  list.replaceChildren(h("p", {}, `${total} takes`), h("table", {}, episodes.map((row) => h(
    "tr", { onclick: () => open(row) },
    h("td", {}, row.task), h("td", {}, row.operator), h("td", {}, row.outcome), h("td", {}, `${row.duration.toFixed(1)} s`),
  ))));
}

document.body.classList.toggle("embedded", new URLSearchParams(location.search).has("embed"));
document.addEventListener("keydown", (event) => { if (view?.key(event)) event.preventDefault(); });
attempt(load);
