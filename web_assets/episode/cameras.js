// The cameras' images of one or several takes, at one time; fetched and decoded ahead.

import { h } from "../dataset/dom.js";
import { newest } from "./playhead.js";

const AT_ONCE = 6; // requests: browsers open no more connections to one server
const AHEAD = 14; // images of each camera while playing
const AROUND = 2; // images before and after the one that stands
const KEPT = 160; // decoded images of each camera, 0.3 MB each
const NARROWEST = 190; // [px] of a tile; of several takes only as many cameras are shown as find room

// The images of one camera of one take.
class Film {
  constructor(url, canvas) {
    Object.assign(this, { url, canvas, times: [], kept: new Map(), coming: new Set(), wanted: 0, shown: -1 });
    this.pen = canvas.getContext("2d");
  }

  numberAt(time) {
    return this.times.length ? newest(this.times, time) : 0;
  }

  has(number) {
    return this.kept.has(number) || this.coming.has(number);
  }

  async fetch(number) {
    this.coming.add(number);
    try {
      const answer = await fetch(this.url(number));
      if (!answer.ok) return;
      this.kept.set(number, await createImageBitmap(await answer.blob()));
      while (this.kept.size > KEPT) {
        const [oldest, bitmap] = this.kept.entries().next().value;
        bitmap.close();
        this.kept.delete(oldest);
      }
      if (number === this.wanted) this.show(number);
    } catch {
      // The server has gone, or the take; whoever asks for its plots is told.
    } finally {
      this.coming.delete(number);
    }
  }

  show(number) {
    this.wanted = number;
    const bitmap = this.kept.get(number);
    if (!bitmap || number === this.shown) return;
    if (this.canvas.width !== bitmap.width) [this.canvas.width, this.canvas.height] = [bitmap.width, bitmap.height];
    this.pen.drawImage(bitmap, 0, 0);
    this.shown = number;
    this.canvas.dataset.number = number;
  }

  close() {
    this.kept.forEach((bitmap) => bitmap.close());
    this.kept.clear();
  }
}

export class Cameras {
  // `takes` as `view.js` makes them; their images' times may come later, see `setTimes`.
  constructor(api, takes, width) {
    this.api = api;
    this.queue = [];
    this.running = 0;
    const most = takes.length > 1 ? Math.max(1, Math.floor(width / NARROWEST / takes.length)) : Infinity;
    this.films = takes.map((take) => take.row.cameras.slice(0, most).map((camera) => this.film(take, camera)));
    const label = (take) => takes.length > 1 && h("span", { class: "letter", style: { background: take.color } }, take.letter);
    this.element = h("div", { class: "cameras" }, takes.map((take, index) => this.films[index].map((film) => h(
      "figure", {}, film.canvas, h("figcaption", {}, label(take), film.camera.replaceAll("_", " ")),
    ))).flat());
    this.element.hidden = !this.element.children.length;
    this.want(takes.map(() => 0), false);
  }

  film(take, camera) {
    const path = `/episodes/${encodeURIComponent(take.row.episode_id)}/images/${encodeURIComponent(camera)}/`;
    const canvas = h("canvas", { width: 320, height: 240, "aria-label": `${camera} camera` });
    return Object.assign(new Film((number) => this.api.url(path + number), canvas), { camera });
  }

  setTimes(index, images) {
    for (const film of this.films[index]) film.times = images[film.camera] ?? [];
  }

  // At the time of each take [s].
  show(times, isPlaying) {
    this.want(this.films.map((_, index) => times[index]), isPlaying);
  }

  close() {
    this.queue = [];
    this.films.flat().forEach((film) => film.close());
  }

  // First what is to be seen now, then what will be.
  want(times, isPlaying) {
    const now = [];
    const soon = [];
    this.films.forEach((films, index) => {
      for (const film of films) {
        const number = film.numberAt(times[index]);
        film.show(number);
        now.push([film, number]);
        const last = Math.max(film.times.length - 1, 0);
        const near = isPlaying
          ? Array.from({ length: AHEAD }, (_, step) => number + 1 + step)
          : Array.from({ length: AROUND }, (_, step) => [number + 1 + step, number - 1 - step]).flat();
        soon.push(...near.filter((each) => each >= 0 && each <= last).map((each) => [film, each]));
      }
    });
    soon.sort((one, other) => Math.abs(one[1] - one[0].wanted) - Math.abs(other[1] - other[0].wanted));
    this.queue = [...now, ...soon].filter(([film, number]) => !film.has(number));
    this.work();
  }

  work() {
    while (this.running < AT_ONCE && this.queue.length) {
      const [film, number] = this.queue.shift();
      if (film.has(number)) continue;
      this.running += 1;
      film.fetch(number).finally(() => {
        this.running -= 1;
        this.work();
      });
    }
  }
}
