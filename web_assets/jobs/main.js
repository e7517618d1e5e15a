// The page of jobs: demonstrate, train and evaluate, what runs, and what came of it.
//
// /train?tab=evaluate&job=ID&run=NAME&run=NAME&evaluation=ID&against=ID  shows the same again.

import { api } from "../dataset/api.js";
import { attempt, h } from "../dataset/dom.js";
import { DemoForm } from "./demo_form.js";
import { EvaluateForm } from "./evaluate_form.js";
import { EvaluationView } from "./evaluation_view.js";
import { author, link } from "./fields.js";
import { JobList } from "./job_list.js";
import { RunView } from "./run_view.js";
import { TrainForm } from "./train_form.js";

const PERIOD = 1000; // [ms] between two looks; the studio answers 304 where nothing changed
const SELDOM = 10; // looks after which runs and evaluations are asked for, too: others make some
const VIEWS = { demo: "Demonstrate", train: "Train", evaluate: "Evaluate" };

const at = (id) => document.getElementById(id);
const page = { view: "train", job: null, runs: [], evaluation: null, against: null };
let jobs = [], runs = [], evaluations = [], looks = 0;

const list = new JobList(at("jobs"), {
  open: (id) => open(jobs.find(({ job }) => job.job_id === id)),
  openRun: (name, isMore) => go({ job: null, runs: isMore ? toggled(page.runs, name) : [name], evaluation: null }),
  openEvaluation: (id) => go({ job: null, runs: [], evaluation: id, against: null }),
  openSweep: (name) => go({ job: null, runs: jobs.filter(({ job }) => job.sweep === name).map(({ job }) => job.subject), evaluation: null }),
  again: (job) => again(job),
  changed: () => attempt(() => look(true)),
});
const forms = {
  demo: new DemoForm({ started }),
  train: new TrainForm({ started, demonstrate: (task) => { go({ view: "demo" }); forms.demo.choose(task); } }),
  evaluate: new EvaluateForm({ started }),
};
const runView = new RunView(at("closer"), {
  evaluate: (name) => { go({ view: "evaluate" }); forms.evaluate.choose(name); },
  changed: () => attempt(() => look(true)),
  train: (task) => { go({ view: "train" }); forms.train.choose(task); },
});
const evaluationView = new EvaluationView(at("closer"), { against: (id) => go({ against: id }) });

const toggled = (names, name) => (names.includes(name) ? names.filter((other) => other !== name) : [...names, name]);
const evaluationOf = (job) => job.progress?.result?.evaluation ?? null;

function open(now) {
  go({ job: now.job.job_id, runs: now.job.kind === "train" ? [now.job.subject] : [], evaluation: evaluationOf(now), against: null });
}

function started(now) {
  open(now);
  attempt(() => look(true));
}

// The form as that job was asked for, to ask again with changes.
function again(job) {
  go({ view: job.job.kind });
  forms[job.job.kind].fill(job.job);
}

function go(changes) {
  Object.assign(page, changes);
  const told = new URLSearchParams(location.search);
  for (const name of ["tab", "job", "run", "evaluation", "against"]) told.delete(name);
  if (page.view !== "train") told.set("tab", page.view);
  for (const name of ["job", "evaluation", "against"]) if (page[name]) told.set(name, page[name]);
  for (const name of page.runs) told.append("run", name);
  const text = told.toString();
  history.replaceState(null, "", location.pathname + (text && `?${text}`));
  show();
}

function show() {
  for (const link of document.querySelectorAll("#top [data-view]")) link.classList.toggle("here", link.dataset.view === page.view);
  const form = forms[page.view];
  if (at("ask").firstChild !== form.element) at("ask").replaceChildren(form.element);
  form.tell({ runs, evaluations });
  list.show({ view: page.view, jobs, runs, evaluations, chosen: page });
  const job = jobs.find((now) => now.job.job_id === page.job);
  const isEvaluation = page.evaluation || job?.job.kind === "evaluate";
  if (isEvaluation) {
    runView.close();
    evaluationView.show({ id: page.evaluation ?? (job && evaluationOf(job)), against: page.against, job, evaluations });
  } else {
    evaluationView.close();
    runView.show({ names: page.runs, job, runs, jobs, evaluations });
  }
}

async function look(isNow = false) {
  if (document.hidden && !isNow) return;
  const before = jobs;
  jobs = await api.get("/jobs");
  const isOver = (now) => !["queued", "running", "lost"].includes(now.standing.state);
  const ended = jobs.filter(isOver).length !== before.filter(isOver).length || jobs.length !== before.length;
  if (ended || isNow || looks % SELDOM === 0) {
    [runs, evaluations] = await Promise.all([api.get("/runs"), api.get("/evaluations")]);
  }
  if (ended && looks) attempt(() => forms.train.refresh());
  looks += 1;
  show();
}

async function keepLooking() {
  try {
    await look();
    document.body.classList.remove("silent");
  } catch (error) {
    if (error.status === undefined) console.error(error);
    document.body.classList.add("silent"); // it says so at the top, and goes on asking
  }
  setTimeout(keepLooking, PERIOD);
}

at("top").append(
  h("b", {}, "Comp-ACT Studio"),
  h("nav", {},
    h("a", { href: "/", target: "_top" }, "Drive"),
    h("a", { href: link("/dataset") }, "Dataset"),
    Object.entries(VIEWS).map(([view, label]) => h("a", { href: `/train?tab=${view}`, "data-view": view, onclick: (event) => { event.preventDefault(); go({ view }); } }, label))),
  h("span", { class: "silence" }, "The studio does not answer; jobs go on by themselves."),
  h("span", { class: "note" }, "Jobs run behind everything else on this machine, and leave one core to the live session."),
);

const given = new URLSearchParams(location.search);
const tab = given.get("tab") ?? given.get("view"); // a view inside the studio's page is another thing
document.body.classList.toggle("embedded", given.has("embed"));
go({
  view: tab in VIEWS ? tab : "train",
  job: given.get("job"),
  runs: given.getAll("run"),
  evaluation: given.get("evaluation"),
  against: given.get("against"),
});
if (given.get("collection")) forms.train.chooseCollection(given.get("collection"));
attempt(async () => { author.known = (await api.get("/me")).name; });
attempt(() => Promise.all(Object.values(forms).map((form) => form.load()))).then(keepLooking);
document.addEventListener("visibilitychange", () => { if (!document.hidden) attempt(() => Promise.all([look(true), forms.train.refresh()])); });
