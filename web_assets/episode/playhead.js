// The time that is shown, and the stretch of time that is in view; both tell whoever listens.

export const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const STEP = 0.05; // [s] from one camera image to the next
const NEAREST = 0.02; // [s] the shortest stretch to zoom to

export function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

// The common axis of one or several takes [s]: from `min` to `max`, of which `from` to `to` is in view.
export class Axis {
  constructor(min, max) {
    Object.assign(this, { min, max: Math.max(max, min + NEAREST), listeners: [] });
    [this.from, this.to] = [this.min, this.max];
  }

  get isWhole() {
    return this.from === this.min && this.to === this.max;
  }

  show(from, to) {
    const length = clamp(to - from, NEAREST, this.max - this.min);
    this.from = clamp(from, this.min, this.max - length);
    this.to = this.from + length;
    this.listeners.forEach((tell) => tell());
  }

  showAll() {
    this.show(this.min, this.max);
  }

  // Around a time that stays where it is.
  zoom(factor, at) {
    this.show(at - (at - this.from) * factor, at + (this.to - at) * factor);
  }

  pan(share) {
    const by = share * (this.to - this.from);
    this.show(this.from + by, this.to + by);
  }

  // So that a time is in view.
  follow(time) {
    const length = this.to - this.from;
    if (time < this.from || time > this.to) this.show(time - 0.1 * length, time + 0.9 * length);
  }

  share(time) {
    return (time - this.from) / (this.to - this.from);
  }
}

export class Playhead {
  constructor(axis) {
    Object.assign(this, { axis, time: axis.min, speed: 1, isPlaying: false, listeners: [] });
  }

  seek(time) {
    this.isPlaying = false;
    this.move(time);
  }

  // So many images further; on their grid.
  step(count) {
    const steps = Number((this.time / STEP).toFixed(6)); // 2.9999999 is 3
    this.seek(STEP * ((count > 0 ? Math.floor(steps) : Math.ceil(steps)) + count));
    this.axis.follow(this.time);
  }

  toggle() {
    if (this.isPlaying) return this.seek(this.time);
    if (this.time >= this.axis.max - 1e-6) this.time = this.axis.min;
    this.isPlaying = true;
    let before = performance.now();
    const advance = (now) => {
      if (!this.isPlaying) return;
      this.move(this.time + (this.speed * Math.max(now - before, 0)) / 1000);
      before = now;
      if (this.time >= this.axis.max) this.seek(this.axis.max);
      this.axis.follow(this.time);
      requestAnimationFrame(advance);
    };
    requestAnimationFrame(advance);
    this.move(this.time);
  }

  setSpeed(speed) {
    this.speed = speed;
    this.move(this.time);
  }

  // To the next slower or faster of the usual ones.
  shift(steps) {
    this.setSpeed(SPEEDS[clamp(SPEEDS.indexOf(this.speed) + steps, 0, SPEEDS.length - 1)]);
  }

  stop() {
    this.isPlaying = false;
    this.listeners = [];
  }

  move(time) {
    this.time = clamp(time, this.axis.min, this.axis.max);
    this.listeners.forEach((tell) => tell());
  }
}

// Index of the last of rising `times` at or before `time`, else of the first.
export function newest(times, time) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time + 1e-4) low = middle + 1;
    else high = middle;
  }
  return Math.max(low - 1, 0);
}
