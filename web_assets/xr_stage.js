// What one sees in the headset: the twin where the operator works, forces, a board of words, the cameras' images.
// Everything of the robot lies in the group `world`, whose transform the studio tells; see `stage_of` in xr.py.

import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { FOLLOWS, LOST, MOST_FORCE, driver } from "/assets/xr_words.js";

const POSES = 1, IMAGE = 2, INK = 3; // kinds of binary messages
const METRES_PER_NEWTON = 0.006; // of a force arrow
const BOARD = { width: 1.0, height: 0.46, pixels: 1024, away: 1.25, above: 0.0 }; // [m], [px], [m], [m]
// Where images stand: [m] to the right of the board's middle and above it, and how far they turn to the eyes.
const IMAGE_PLACES = [[-0.83, 0, 0.5], [0.83, 0, -0.5], [0, 0.47, 0]];
const IMAGE_SIZE = [0.6, 0.45]; // [m]
const CALM = "#d8dce3", DIM = "#8f97a3", GOOD = "#4cc38a", WARN = "#ffb84d", BAD = "#f5544a", BACK = "rgba(20, 23, 28, 0.86)";

export class Stage {
  #renderer;
  #scene = new THREE.Scene();
  #camera = new THREE.PerspectiveCamera();
  #world = new THREE.Group();
  #twin = new THREE.Group();
  #nodes = [];
  #ink = null;
  #task = "";
  #arms = []; // per arm: arrow and ghost
  #board = new Board();
  #screens = new THREE.Group();
  #hands = { left: marker(), right: marker() };
  #head = null;
  #placed = ""; // for which stage the board stands where it does
  #state = null;
  #floor;

  #waiting;

  // `waiting` tells what takes hold of an arm.
  constructor(renderer, waiting) {
    this.#renderer = renderer;
    this.#waiting = waiting;
    this.#world.visible = false;
    this.#world.add(this.#twin);
    this.#scene.add(this.#world, this.#board.mesh, this.#screens, this.#hands.left, this.#hands.right);
    this.#scene.add(new THREE.HemisphereLight(0xffffff, 0x555c66, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(1, 3, 2);
    this.#scene.add(sun);
    this.#floor = new THREE.GridHelper(8, 16, 0x38414e, 0x262c34);
    this.#scene.add(this.#floor);
  }

  begin(isPassthrough) {
    this.#scene.background = isPassthrough ? null : new THREE.Color(0x14171c);
    this.#floor.visible = !isPassthrough;
    this.#placed = "";
  }

  wants(twin, images) {
    this.#twin.visible = twin;
    this.#screens.visible = images;
  }

  say(words) { this.#board.write({ ...this.#state, said: words }, this.#waiting()); }

  show(state) {
    this.#state = state;
    if (state.task !== this.#task) this.#load(state.task);
    if (state.stage) {
      const [x, y, z, i, j, k, w] = state.stage;
      this.#world.position.set(x, y, z);
      this.#world.quaternion.set(i, j, k, w);
      this.#world.visible = true;
    }
    state.arms.forEach((arm, n) => this.#showArm(n, arm));
    this.#board.write(state, this.#waiting());
  }

  showBinary(kind, data) {
    if (kind === POSES) this.#pose(new Float32Array(data.slice(1)));
    else if (kind === IMAGE) this.#showImage(new Uint8Array(data, 1, 1)[0], data.slice(2));
    else if (kind === INK) this.#showInk(data.slice(1));
  }

  draw(head, hands, isLed) {
    this.#head = head ?? this.#head;
    this.#place();
    for (const [side, mark] of Object.entries(this.#hands)) {
      mark.visible = Boolean(hands[side]);
      if (hands[side]) {
        setRoom(mark, hands[side].pose);
        mark.children[0].material.color.set(isLed(side) ? GOOD : DIM);
      }
    }
    this.#renderer.render(this.#scene, this.#camera);
  }

  // The board and the images stand ahead of where the operator faced when the stage was set.
  #place() {
    const stage = JSON.stringify(this.#state?.stage ?? null);
    if (!this.#head || stage === this.#placed) return;
    this.#placed = stage;
    const [x, y, z, i, j, k, w] = this.#head;
    const ahead = new THREE.Vector3(0, 0, -1).applyQuaternion(new THREE.Quaternion(i, j, k, w));
    const yaw = Math.atan2(-ahead.x, -ahead.z);
    for (const group of [this.#board.mesh, this.#screens]) {
      group.position.set(x - BOARD.away * Math.sin(yaw), y + BOARD.above, z - BOARD.away * Math.cos(yaw));
      group.rotation.set(0, yaw, 0);
    }
  }

  async #load(task) {
    this.#task = task;
    this.#twin.clear();
    this.#nodes = [];
    this.#ink = null;
    for (const { arrow, ghost } of this.#arms) this.#world.remove(arrow, ghost);
    this.#arms = [];
    const scene = await (await fetch(`/xr/scene/${task}`)).json();
    if (this.#task !== task) return;
    const [fixed, ...nodes] = scene.parts.map((url) => part(url));
    this.#twin.add(fixed, ...nodes);
    this.#nodes = nodes;
    if (scene.picture) {
      const { pose, width, height } = scene.picture;
      const paper = new THREE.MeshBasicMaterial({ polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -2 });
      this.#ink = new THREE.Mesh(new THREE.PlaneGeometry(width, height), paper);
      this.#ink.visible = false;
      setWorld(this.#ink, pose);
      this.#twin.add(this.#ink);
    }
  }

  #pose(numbers) {
    if (numbers.length !== 7 * this.#nodes.length) return; // of the scene before
    this.#nodes.forEach((node, n) => setWorld(node, numbers.subarray(7 * n, 7 * n + 7)));
  }

  #showArm(n, arm) {
    this.#arms[n] ??= this.#addArm();
    const { arrow, ghost } = this.#arms[n];
    setWorld(ghost, arm.target);
    arrow.visible = arm.newtons > 1;
    if (!arrow.visible) return;
    arrow.position.set(...arm.tcp.slice(0, 3));
    arrow.setDirection(new THREE.Vector3(...arm.force).normalize());
    const length = METRES_PER_NEWTON * arm.newtons + 0.02;
    arrow.setLength(length, 0.02, 0.014);
  }

  #addArm() {
    const arrow = new THREE.ArrowHelper(undefined, undefined, 0.1, BAD);
    const ghost = new THREE.AxesHelper(0.06);
    this.#world.add(arrow, ghost);
    return { arrow, ghost };
  }

  async #showImage(number, jpeg) {
    const bitmap = await createImageBitmap(new Blob([jpeg]), { imageOrientation: "flipY" });
    while (this.#screens.children.length <= number && number < IMAGE_PLACES.length) this.#screens.add(screen(this.#screens.children.length));
    const target = this.#screens.children[number];
    if (target) setPicture(target, bitmap);
  }

  async #showInk(png) {
    const bitmap = await createImageBitmap(new Blob([png]), { imageOrientation: "flipY" });
    if (!this.#ink) return;
    setPicture(this.#ink, bitmap);
    this.#ink.visible = true;
  }
}

// A board of words, drawn only when they change.
class Board {
  #canvas = Object.assign(document.createElement("canvas"), {
    width: BOARD.pixels, height: Math.round((BOARD.pixels * BOARD.height) / BOARD.width),
  });
  #texture = new THREE.CanvasTexture(this.#canvas);
  #shown = "";

  constructor() { this.#texture.colorSpace = THREE.SRGBColorSpace; }

  mesh = new THREE.Mesh(
    new THREE.PlaneGeometry(BOARD.width, BOARD.height),
    new THREE.MeshBasicMaterial({ map: this.#texture, transparent: true }),
  );

  write(state, waiting) {
    const words = content(state, waiting);
    const key = JSON.stringify(words);
    if (key === this.#shown) return;
    this.#shown = key;
    this.#paint(words);
    this.#texture.needsUpdate = true;
  }

  #paint({ head, color, arms, said }) {
    const pen = this.#canvas.getContext("2d"), { width, height } = this.#canvas;
    pen.clearRect(0, 0, width, height);
    pen.fillStyle = BACK;
    pen.roundRect(0, 0, width, height, 24);
    pen.fill();
    text(pen, head, 36, 66, 44, color);
    arms.forEach((arm, n) => {
      const left = 36 + (n * (width - 36)) / arms.length, wide = (width - 36) / arms.length - 36;
      text(pen, arm.name, left, 136, 40, CALM);
      text(pen, arm.mode, left, 188, 40, "#fff", wide);
      text(pen, arm.led, left, 236, 34, arm.engaged ? GOOD : DIM, wide);
      pen.fillStyle = "#2a2f37";
      pen.fillRect(left, 258, wide, 22);
      pen.fillStyle = arm.newtons > 30 ? BAD : WARN;
      pen.fillRect(left, 258, (wide * Math.min(arm.newtons, MOST_FORCE)) / MOST_FORCE, 22);
      text(pen, `${arm.newtons} N`, left, 322, 34, CALM);
      lines(pen, arm.why, left, 368, 28, WARN, wide);
    });
    text(pen, said, 36, height - 24, 30, WARN, width - 72);
    pen.beginPath();
  }
}

function content(state, waiting) {
  const { phase, countdown = 0, seconds = 0, session, kept } = state;
  const who = driver(state);
  const time = `${String(Math.floor(seconds / 60)).padStart(2, "0")}:${String(Math.floor(seconds) % 60).padStart(2, "0")}`;
  const [head, color] = session in LOST ? [LOST[session], BAD]
    : phase === "recording" ? [`● REC ${time}`, BAD]
    : phase === "countdown" ? [`Recording in ${Math.ceil(countdown)}`, WARN]
    : [kept ? `${who} · last take: ${kept}` : who, CALM];
  const arms = (state.arms ?? []).map(({ name, mode, engaged, newtons, why }) => ({
    name, mode, engaged, newtons: Math.round(newtons), why: why.slice(0, 120), led: engaged ? FOLLOWS : waiting,
  }));
  return { head, color, arms, said: (state.said ?? "").slice(0, 90) };
}

function text(pen, words, x, y, size, color, most) {
  pen.font = `600 ${size}px system-ui, sans-serif`;
  pen.fillStyle = color;
  pen.fillText(words, x, y, most);
}

// At most two lines.
function lines(pen, words, x, y, size, color, wide) {
  pen.font = `600 ${size}px system-ui, sans-serif`;
  const rows = [""];
  for (const word of words.split(" ")) {
    const longer = `${rows.at(-1)} ${word}`.trim();
    if (pen.measureText(longer).width <= wide) rows[rows.length - 1] = longer;
    else rows.push(word);
  }
  rows.slice(0, 2).forEach((row, n) => text(pen, row, x, y + n * 1.2 * size, size, color, wide));
}

function part(url) {
  const group = new THREE.Group();
  if (url) new GLTFLoader().load(url, ({ scene }) => group.add(scene));
  return group;
}

function screen(number) {
  const [right, up, turn] = IMAGE_PLACES[number];
  const mesh = new THREE.Mesh(new THREE.PlaneGeometry(...IMAGE_SIZE), new THREE.MeshBasicMaterial());
  mesh.position.set(right, up, Math.abs(turn) * 0.25);
  mesh.rotation.y = turn;
  return mesh;
}

function setPicture(mesh, bitmap) {
  mesh.material.map?.image.close?.();
  mesh.material.map?.dispose();
  const texture = new THREE.Texture(bitmap);
  texture.flipY = false; // the bitmap was turned where it was decoded
  texture.colorSpace = THREE.SRGBColorSpace;
  texture.needsUpdate = true;
  mesh.material.map = texture;
  mesh.material.needsUpdate = true;
}

function marker() {
  const group = new THREE.Group();
  const grip = new THREE.Mesh(new THREE.CapsuleGeometry(0.013, 0.06), new THREE.MeshStandardMaterial({ color: DIM }));
  grip.rotation.x = Math.PI / 2;
  group.add(grip, new THREE.AxesHelper(0.05));
  group.visible = false;
  return group;
}

// A pose of the room: position, xyzw.
function setRoom(object, [x, y, z, i, j, k, w]) {
  object.position.set(x, y, z);
  object.quaternion.set(i, j, k, w);
}

// A pose of the world: position, wxyz.
function setWorld(object, [x, y, z, w, i, j, k]) {
  object.position.set(x, y, z);
  object.quaternion.set(i, j, k, w);
}
