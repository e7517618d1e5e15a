// Takes for other programs: a question, then a job of the studio with its progress, which outlives the page.

import { api } from "./api.js";
import { ask } from "./dialogs.js";
import { attempt, h, toast } from "./dom.js";

const FORMATS = [
  ["lerobot", "LeRobot v3", "Constant rate, H.264; wrench and stiffness as named columns. One task, the same cameras."],
  ["act-hdf5", "ACT HDF5", "The layout of the Comp-ACT paper: one file a take, images included."],
  ["rrd", "Rerun", "One recording a take: the robot in 3-D, cameras, forces, stiffness."],
];
const LOOK = 1000; // [ms] between looks at a running job

// Ask how, and begin. `about` is {words, task, ...which takes: episode_ids, collection or filters}.
export function start({ words, task, ...which }, author) {
  const explained = h("p", { class: "dim" }, FORMATS[0][2]);
  const name = h("input", { id: "export-name", name: "name", required: true, maxlength: "100", pattern: "[A-Za-z0-9][\\w.\\-]*", value: `${task ?? "takes"}-lerobot`, title: "Letters, digits, - _ .", autocomplete: "off" });
  let isNamed = false;
  name.addEventListener("input", () => { isNamed = true; });
  const choose = (format) => {
    explained.textContent = FORMATS.find(([value]) => value === format)[2];
    if (!isNamed) name.value = `${task ?? "takes"}-${format}`;
    form.querySelector(".sampled").hidden = format === "rrd";
  };
  const form = h("div", {},
    h("p", {}, words), h("p", { class: "dim" }, "As they are annotated now; trims are respected, and no take is left out."),
    h("div", { class: "fields" },
      h("label", {}, "Format"),
      h("div", { class: "choices" }, FORMATS.map(([value, title], index) => h("label", {},
        h("input", { type: "radio", name: "format", value, checked: index === 0, onchange: () => choose(value) }), h("span", {}, title)))),
      h("span", {}), explained,
      h("label", { for: "export-name" }, "Name"), name,
      h("label", {}, "Images"),
      h("div", { class: "choices" }, h("label", {}, h("input", { type: "checkbox", name: "images", checked: true }), h("span", {}, "with all cameras")))),
    h("div", { class: "fields sampled" },
      h("label", { for: "rate" }, "Rate"),
      h("span", {}, h("input", { id: "rate", name: "rate", type: "number", min: "1", max: "100", value: "20", required: true }), " Hz"),
      h("label", {}, "Actions"),
      h("div", { class: "choices" }, [["cartesian", "pose and stiffness"], ["joints", "joints"]].map(([value, title], index) => h("label", {},
        h("input", { type: "radio", name: "actions", value, checked: index === 0 }), h("span", {}, title))))));
  ask("Export", form, {
    button: "Export",
    act: async (given) => {
      const asked = {
        kind: "export", author, ...which, name: given.get("name"), format: given.get("format"),
        rate: Number(given.get("rate")), actions: given.get("actions"), cameras: given.get("images") ? null : [],
      };
      follow(await api.post("/jobs", asked));
    },
  });
  name.select();
}

// Show those that run, also those that somebody else began.
export async function followAll() {
  for (const now of await api.get("/jobs", { kind: "export" })) if (isRunning(now)) follow(now);
}

const isRunning = ({ standing }) => ["queued", "running"].includes(standing.state);

async function follow(now) {
  const id = encodeURIComponent(now.job.job_id);
  const bar = h("progress", { max: 1 });
  const words = h("span", { class: "dim" });
  const cancel = h("button", { onclick: () => attempt(() => api.post(`/jobs/${id}/cancel`)) }, "Cancel");
  const card = h("div", {}, h("b", {}, now.job.title), h("div", { class: "line" }, bar, cancel), words);
  document.getElementById("running").append(card);
  while (isRunning(now)) {
    show(now, bar, words);
    await new Promise((resolve) => { setTimeout(resolve, LOOK); });
    now = await api.get(`/jobs/${id}`).catch(() => now); // a studio that is gone for a moment
  }
  card.remove();
  end(now);
}

function show({ standing, progress, seconds_left: left }, bar, words) {
  if (progress?.total) bar.value = progress.done / progress.total;
  else bar.removeAttribute("value");
  const rest = left === null ? "" : left < 90 ? `${Math.ceil(left)} s left · ` : `${Math.ceil(left / 60)} min left · `;
  words.textContent = standing.state === "queued" ? "waits for another job" : `${rest}${progress?.what || "begins"}`;
}

function end({ job, standing, last_lines: lines }) {
  if (standing.state === "done") toast(`${job.title}: in exports/${job.subject} of the data folder.`);
  else if (standing.state === "cancelled") toast(`${job.title}: cancelled; nothing was left behind.`);
  else toast(`${job.title} did not end well: ${lines.at(-1) || standing.why || standing.state}`, { kind: "bad" });
}
