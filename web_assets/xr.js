// The headset's page: tests what a session needs, keeps the operator's settings, shows what the robot does.

import { Channel } from "/assets/xr_channel.js";
import { FOLLOWS, LOST, MOST_FORCE, driver } from "/assets/xr_words.js";

const FUNCTIONS = {
  clutch: "Clutch",
  gripper: "Gripper",
  stiffness: "Stiffness",
  record: "Record; long: discard",
  discard: "Discard",
  face: "Ahead is where I face",
};
const BUTTONS = { menu: "B / Y", trigger: "Trigger", squeeze: "Grip", primary: "A / X", stick: "Thumbstick", pad: "Touchpad" };
const PRESETS = {
  paper: { clutch: "menu", gripper: "trigger", stiffness: "squeeze", record: "primary", discard: "", face: "stick", hold_to_clutch: false },
  grip: { clutch: "squeeze", gripper: "trigger", stiffness: "menu", record: "primary", discard: "", face: "stick", hold_to_clutch: true },
};
const UNITS = { scale: "×", dead_band: " N", full: " N", strength: "", countdown: " s" };
const STORED = "studio headset settings";
const PINGS = 60;
const SLOW = 30; // [ms] round trip above which motion begins to feel late
const UNSTEADY = 8; // [ms] of jitter likewise

const find = (id) => document.getElementById(id);
const form = find("settings");

// Settings

function build() {
  for (const [name, words] of Object.entries(FUNCTIONS)) {
    const label = Object.assign(document.createElement("label"), { htmlFor: name, textContent: words });
    const choice = Object.assign(document.createElement("select"), { id: name, name });
    if (name !== "clutch") choice.append(new Option("no button", ""));
    for (const [button, text] of Object.entries(BUTTONS)) choice.append(new Option(text, button));
    find("mapping").append(label, choice);
  }
  fill({ ...PRESETS.paper, ...stored() });
  for (const button of form.querySelectorAll("[data-preset]")) {
    button.onclick = () => { fill(PRESETS[button.dataset.preset]); changed(); };
  }
  form.oninput = changed;
  form.onsubmit = (event) => event.preventDefault();
}

function stored() {
  try {
    return JSON.parse(localStorage.getItem(STORED) ?? "{}");
  } catch {
    return {}; // what is no JSON was not written by us
  }
}

function fill(values) {
  for (const [name, value] of Object.entries(values)) {
    const field = form.elements[name];
    if (field?.type === "checkbox") field.checked = value;
    else if (field) field.value = value;
  }
  showNumbers();
}

function settings() {
  const values = {};
  for (const field of form.elements) {
    if (!field.name) continue;
    if (field.type === "checkbox") values[field.name] = field.checked;
    else values[field.name] = field.type === "range" || (field.name === "view" && field.value) ? Number(field.value) : field.value;
  }
  return values;
}

function changed() {
  showNumbers();
  localStorage.setItem(STORED, JSON.stringify(settings()));
  tell();
}

function showNumbers() {
  for (const field of form.querySelectorAll("[type=range]")) {
    field.nextElementSibling.textContent = `${Number(field.value)}${UNITS[field.name]}`;
  }
}

function tell() {
  const { twin, images, ...given } = settings();
  const mapping = { hold_to_clutch: given.hold_to_clutch };
  delete given.hold_to_clutch;
  for (const name of Object.keys(FUNCTIONS)) {
    mapping[name] = given[name] || null;
    delete given[name];
  }
  channel.say({ type: "settings", mapping, ...given, view: given.view === "" ? null : given.view });
  headset?.watch(twin, images);
}

// The self-test

const CHECKS = {
  context: "Secure page", webxr: "WebXR", drawing: "3-D library", vr: "VR", ar: "Passthrough",
  controllers: "Controllers", trip: "Round trip", jitter: "Jitter",
};

function verdict(name, how, words) {
  const row = find(`check-${name}`);
  row.className = how;
  row.lastChild.textContent = words;
}

function buildChecks() {
  for (const [name, words] of Object.entries(CHECKS)) {
    const row = Object.assign(document.createElement("li"), { id: `check-${name}` });
    row.append(Object.assign(document.createElement("b"), { textContent: words }), document.createElement("span"));
    find("checks").append(row);
  }
}

async function test() {
  const secure = window.isSecureContext;
  verdict("context", secure ? "yes" : "no", secure ? "HTTPS or this machine"
    : "Browsers offer WebXR over HTTPS only: open the https:// link that `studio serve --host 0.0.0.0` prints.");
  verdict("webxr", navigator.xr ? "yes" : "no", navigator.xr ? "offered by this browser"
    : secure ? "This browser has none. Use the headset's own browser, or Chrome with SteamVR." : "not offered on an insecure page");
  for (const [name, mode] of [["vr", "immersive-vr"], ["ar", "immersive-ar"]]) {
    const offered = Boolean(await navigator.xr?.isSessionSupported(mode).catch(() => false));
    verdict(name, offered ? "yes" : "maybe", offered ? "ready" : "not here: open this page in the headset's own browser");
    find(name).disabled = !(offered && headset);
  }
  if (!seen.size) verdict("controllers", "maybe", "seen as soon as you enter");
  await measure();
}

async function measure() {
  verdict("trip", "", "measuring…");
  verdict("jitter", "", "");
  const trips = (await channel.opens()) ? await channel.measure(PINGS) : [];
  if (trips.length < PINGS / 2) {
    verdict("trip", "no", "The studio does not answer.");
    verdict("jitter", "", "unknown");
    return;
  }
  const sorted = [...trips].sort((a, b) => a - b);
  const at = (share) => sorted[Math.floor(share * (sorted.length - 1))];
  const jitter = trips.slice(1).reduce((sum, trip, n) => sum + Math.abs(trip - trips[n]), 0) / (trips.length - 1);
  const ms = (value) => `${value.toFixed(1)} ms`;
  verdict("trip", at(0.95) < SLOW ? "yes" : "maybe", `${ms(at(0.5))}, 95 % within ${ms(at(0.95))}`);
  verdict("jitter", jitter < UNSTEADY ? "yes" : "maybe",
    ms(jitter) + (jitter < UNSTEADY ? "" : "; a cable or the 5 GHz band would steady it"));
}

// What the robot does now

function show(state) {
  find("session").textContent = `${state.task} · ${LOST[state.session] ?? driver(state)}`;
  find("said").textContent = state.said || why;
  find("take").textContent = { idle: state.kept && `Last take: ${state.kept}`, countdown: `Recording in ${Math.ceil(state.countdown)} s`,
    recording: `Recording, ${state.seconds.toFixed(0)} s` }[state.phase];
  find("way").textContent = headset?.session ? `Poses come ${state.latency.toFixed(1)} ms late, jitter ${state.jitter.toFixed(1)} ms, ` +
    `${headset.rate.toFixed(0)} a second, ${headset.dropped} dropped` : "";
  const cards = find("arms");
  if (cards.childElementCount !== state.arms.length) cards.replaceChildren(...state.arms.map(card));
  state.arms.forEach((arm, n) => fillCard(cards.children[n], arm));
}

function card() {
  const element = Object.assign(document.createElement("div"), { className: "arm" });
  const row = (words) => `<div class="row"><span>${words}</span><span></span></div>`;
  element.innerHTML = `${row("<b></b>")}${row("Stiffness")}${row("Contact force")}<div class="bar"><i></i></div>` +
    `${row("Vibration")}<div class="bar"><i class="felt"></i></div><p class="why"></p>`;
  return element;
}

function fillCard(element, arm) {
  const [led, mode, force, vibration] = element.querySelectorAll(".row > :last-child");
  const [pressed, felt] = element.querySelectorAll("i");
  element.querySelector("b").textContent = `${arm.name[0].toUpperCase()}${arm.name.slice(1)} arm`;
  led.textContent = arm.engaged ? FOLLOWS : waiting();
  led.className = arm.engaged ? "led" : "dim";
  mode.textContent = arm.mode;
  force.textContent = `${arm.newtons.toFixed(1)} N`;
  vibration.textContent = `${(100 * arm.amplitude).toFixed(0)} %`;
  pressed.style.width = `${Math.min(100, (100 * arm.newtons) / MOST_FORCE)}%`;
  felt.style.width = `${100 * arm.amplitude}%`;
  element.querySelector("p").textContent = arm.why;
}

// What takes hold of an arm that does not follow.
function waiting() {
  const { clutch, hold_to_clutch } = settings();
  return `${hold_to_clutch ? "hold " : ""}${BUTTONS[clutch] ?? "the clutch"} ${hold_to_clutch ? "to take" : "takes"} hold`;
}

// Entering

let headset = null; // xr_headset.js, once it is loaded
let why = ""; // why the last session ended
const seen = new Set(); // profiles of controllers

const channel = new Channel();
channel.onOpen = tell;
channel.onState = (state) => { show(state); headset?.show(state); };
channel.onBinary = (kind, data) => headset?.showBinary(kind, data);
channel.onLost = () => {
  find("session").textContent = "";
  find("said").textContent = "No connection to the studio; it is tried again every second.";
  headset?.disconnect();
};

async function enter(mode) {
  why = "";
  try {
    await headset.enter(mode);
    tell();
  } catch (error) {
    why = `The session did not start: ${error.message}`;
    find("said").textContent = why;
  }
}

for (const [id, mode] of [["vr", "immersive-vr"], ["ar", "immersive-ar"]]) find(id).onclick = () => enter(mode);
find("again").onclick = test;

build();
buildChecks();
channel.open();
try {
  const { Headset } = await import("/assets/xr_headset.js");
  headset = new Headset(channel, {
    onControllers: (profiles) => {
      profiles.forEach((profile) => seen.add(profile));
      verdict("controllers", "yes", [...seen].join(", "));
    },
    onEnd: (words) => { why = words; find("said").textContent = words; },
    oneArm: () => settings().one_arm,
    waiting,
  });
  verdict("drawing", "yes", "three.js");
} catch (error) {
  verdict("drawing", "no", `three.js is missing; run npm ci --prefix web_assets on the studio's machine (${error.message})`);
}
await test();
