// The socket to the studio: newest controller frame out, state, poses and images in.

const WAITING = 4096; // [bytes] unsent beyond which a frame is dropped: the next one is newer
const RETRY = 1000; // [ms]
const PING_GAP = 20; // [ms]
const KEPT_TRIPS = 50;
const PATIENCE = 5000; // [ms] for a first connection

export class Channel {
  onOpen = () => {};
  onState = () => {};
  onBinary = () => {};
  onLost = () => {};
  #socket = null;
  #trips = []; // [ms] of late

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/xr/ws`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { this.#socket = socket; this.onOpen(); };
    socket.onclose = () => { this.#socket = null; this.onLost(); setTimeout(() => this.open(), RETRY); };
    socket.onmessage = ({ data }) => this.#hear(data);
  }

  // Whether it is open, or soon is.
  async opens() {
    for (let waited = 0; !this.#socket && waited < PATIENCE; waited += PING_GAP) await sleep(PING_GAP);
    return this.#socket !== null;
  }

  // The shortest round trip of late [ms]; null before the first.
  get trip() { return this.#trips.length ? Math.min(...this.#trips) : null; }

  say(message) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  // Whether there was room for it.
  sayNewest(message) {
    if (!this.#socket || this.#socket.bufferedAmount > WAITING) return false;
    this.say(message);
    return true;
  }

  ping() { this.say({ type: "ping", t: performance.now() }); }

  // Round trips [ms] of some pings.
  async measure(count) {
    const before = this.#heardTrips;
    this.#trips = [];
    const trips = this.#measured = [];
    for (let n = 0; n < count; n++) {
      this.ping();
      await sleep(PING_GAP);
    }
    await sleep(10 * PING_GAP);
    this.#measured = null;
    return this.#heardTrips > before ? trips : [];
  }

  #measured = null;
  #heardTrips = 0;

  #hear(data) {
    if (typeof data !== "string") {
      this.onBinary(new Uint8Array(data, 0, 1)[0], data);
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "state") this.onState(message);
    else if (message.type === "pong") this.#note(performance.now() - message.t);
  }

  #note(trip) {
    this.#heardTrips++;
    this.#measured?.push(trip);
    this.#trips.push(trip);
    if (this.#trips.length > KEPT_TRIPS) this.#trips.shift();
  }
}

function sleep(duration) { return new Promise((resolve) => setTimeout(resolve, duration)); }
