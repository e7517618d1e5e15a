// A session in the headset: sends where the controllers are, lets them vibrate, draws the stage.

import * as THREE from "three";
import { Stage } from "/assets/xr_stage.js";

const PING_PERIOD = 200; // [ms]
const RATE = 90; // [Hz] that we ask the headset for
const ENDED = "The session has ended. The arms have let go; enter again to go on.";

export class Headset {
  session = null;
  rate = 0; // [Hz] of frames
  dropped = 0; // frames that had to make room for newer ones
  #channel;
  #on;
  #renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  #stage;
  #space = null;
  #pinged = 0;
  #drawn = 0;
  #isVisible = false;
  #watched = {};
  #state = null;

  constructor(channel, on) {
    this.#channel = channel;
    this.#on = on;
    this.#renderer.xr.enabled = true;
    this.#renderer.xr.setReferenceSpaceType("local-floor");
    this.#stage = new Stage(this.#renderer, on.waiting);
  }

  async enter(mode) {
    const session = await navigator.xr.requestSession(mode, { requiredFeatures: ["local-floor"] });
    session.addEventListener("end", () => this.#end());
    session.addEventListener("visibilitychange", () => this.#look());
    session.addEventListener("inputsourceschange", () => this.#meet());
    await this.#renderer.xr.setSession(session);
    const rates = session.supportedFrameRates ? [...session.supportedFrameRates] : [];
    if (rates.includes(RATE)) session.updateTargetFrameRate(RATE).catch(() => {});
    this.session = session;
    this.#space = this.#renderer.xr.getReferenceSpace();
    this.#space.addEventListener("reset", () => this.#channel.say({ type: "lost", why: "reset" }));
    this.#stage.begin(mode === "immersive-ar");
    this.dropped = 0;
    this.#look();
    this.#meet();
    this.#renderer.setAnimationLoop((time, frame) => frame && this.#draw(time, frame));
  }

  // What the stage wants to be told, while somebody looks at it.
  watch(twin, images) {
    this.#watched = { twin, images };
    this.#stage.wants(twin, images);
    const is = this.session !== null;
    this.#channel.say({ type: "watch", twin: is && twin, images: is && images });
  }

  show(state) {
    this.#state = state;
    this.#stage.show(state);
    if (this.session && this.#isVisible) this.#vibrate(state);
  }

  showBinary(kind, data) { this.#stage.showBinary(kind, data); }

  disconnect() { this.#stage.say("No connection to the studio"); }

  #look() {
    const visibility = this.session?.visibilityState ?? "hidden";
    this.#isVisible = visibility === "visible";
    if (!this.#isVisible) this.#channel.say({ type: "lost", why: visibility === "hidden" ? "hidden" : "blurred" });
  }

  #meet() {
    const profiles = [...(this.session?.inputSources ?? [])].map((source) => source.profiles[0]).filter(Boolean);
    if (profiles.length) this.#on.onControllers(profiles);
  }

  #end() {
    this.#channel.say({ type: "lost", why: "ended" });
    this.#renderer.setAnimationLoop(null);
    this.session = null;
    this.#isVisible = false;
    this.watch(this.#watched.twin ?? false, this.#watched.images ?? false);
    this.#on.onEnd(ENDED);
  }

  #draw(time, frame) {
    const head = frame.getViewerPose(this.#space);
    const hands = {};
    for (const source of this.session.inputSources) {
      const pose = source.gripSpace && frame.getPose(source.gripSpace, this.#space);
      if (pose && (source.handedness === "left" || source.handedness === "right")) hands[source.handedness] = hand(source, pose);
    }
    if (this.#isVisible) this.#send(head, hands);
    if (time > this.#pinged + PING_PERIOD) {
      this.#pinged = time;
      this.#channel.ping();
    }
    if (this.#drawn && time > this.#drawn) this.rate += (1000 / (time - this.#drawn) - this.rate) / 30;
    this.#drawn = time;
    const led = (side) => this.#state && armOf(side, this.#state.arms, this.#on.oneArm());
    this.#stage.draw(head && flat(head), hands, (side) => led(side)?.engaged ?? false);
  }

  #send(head, hands) {
    const message = { type: "frame", t: performance.now(), ...hands };
    if (this.#channel.trip !== null) message.rtt = this.#channel.trip;
    if (head) message.head = flat(head);
    if (!this.#channel.sayNewest(message)) this.dropped++;
  }

  #vibrate(state) {
    for (const source of this.session.inputSources) {
      const arm = armOf(source.handedness, state.arms, this.#on.oneArm());
      const actuator = source.gamepad?.hapticActuators?.[0];
      if (arm?.amplitude > 0 && actuator) actuator.pulse(arm.amplitude, state.pulse);
    }
  }
}

// The arm that a hand leads, as `Controllers` in studio/inputs/controllers.py has it.
function armOf(side, arms, oneArm) {
  if (arms.length === 1) return side === oneArm ? arms[0] : undefined;
  return arms.find(({ name }) => name === side);
}

function flat({ transform: { position: p, orientation: q } }) {
  return [p.x, p.y, p.z, q.x, q.y, q.z, q.w];
}

function hand(source, pose) {
  const buttons = [...(source.gamepad?.buttons ?? [])].slice(0, 16).map((button) => Math.min(1, Math.max(0, button?.value ?? 0)));
  const is_hand = Boolean(source.hand) || source.profiles.some((profile) => profile.includes("hand"));
  return { pose: flat(pose), buttons, is_hand, is_emulated: pose.emulatedPosition };
}
