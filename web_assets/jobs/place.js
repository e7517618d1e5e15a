// Where a job runs: on this machine or a cluster, with how many threads.

import { h } from "../dataset/dom.js";
import { field, numberOf, select } from "./fields.js";

export const HERE = "local";
const ADDRESS = "studio.cluster"; // the last one, in the browser's storage

export class Place {
  // `processes`: also ask how many learn together.
  constructor({ processes = false } = {}) {
    this.hasProcesses = processes;
    this.runner = select("runner", [[HERE, "This machine"], ["cluster", "A Ray cluster"]], () => this.chosen());
    this.address = h("input", { type: "text", name: "address", placeholder: "http://head:8265", spellcheck: false, value: localStorage.getItem(ADDRESS) ?? "", onchange: () => this.chosen() });
    this.processes = h("input", { type: "text", name: "processes", inputmode: "numeric", value: "1" });
    this.threads = h("input", { type: "text", name: "job_threads", inputmode: "numeric", value: "0" });
    this.addressField = field("Address of its head", this.address, "It has to see the data folder at the same path. A GPU is kept for each process where the device is cuda.");
    this.summary = h("summary", {});
    this.element = h("details", {}, this.summary,
      field("Runs on", this.runner), this.addressField,
      processes ? field("Processes", this.processes, "That learn together, through torchrun: one for each GPU.") : null,
      field("Threads", this.threads, "Of the CPU for each process; 0 leaves one core of this machine to the live session."));
    this.chosen();
  }

  chosen() {
    const isHere = this.runner.value === HERE;
    this.addressField.hidden = isHere;
    this.summary.textContent = `Runs on ${isHere ? "this machine" : this.address.value.trim() || "a cluster"}`;
  }

  // As the studio takes it.
  read() {
    const isHere = this.runner.value === HERE, address = this.address.value.trim();
    if (!isHere && !address) throw new Error("Tell the address of the cluster's head, e.g. http://head:8265.");
    if (!isHere) localStorage.setItem(ADDRESS, address);
    const threads = numberOf("Threads", this.threads.value);
    return { runner: isHere ? HERE : address, threads, ...(this.hasProcesses ? { processes: numberOf("Processes", this.processes.value) } : {}) };
  }

  // Of a job.
  write({ runner, processes, threads }) {
    this.runner.value = runner === HERE ? HERE : "cluster";
    if (runner !== HERE) this.address.value = runner;
    this.processes.value = processes;
    this.threads.value = threads;
    this.chosen();
  }
}

export const placeOf = ({ runner }) => (runner === HERE ? "this machine" : runner.replace(/^https?:\/\//, ""));
