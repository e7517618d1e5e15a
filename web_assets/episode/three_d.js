// The 3-D view of the studio's own page: the one around this page where it is embedded, else none.

const AGAIN = 1000; // [ms] while playing: both clocks go on by themselves, and are set again

export class ThreeD {
  constructor(api) {
    this.api = api;
    this.key = new URLSearchParams(location.search).get("view");
    Object.assign(this, { wanted: null, isBusy: false, sent: "", at: 0 });
  }

  get isThere() {
    return this.key !== null;
  }

  // What the 3-D view is to show from now on; `time` is that of the first take [s].
  show(takes, time, speed) {
    if (!this.isThere) return;
    const body = {
      view: this.key,
      episode_ids: takes.slice(0, 4).map((take) => take.row.episode_id),
      shifts: takes.slice(1, 4).map((take) => take.anchor - takes[0].anchor),
      time: Math.max(time, 0),
      speed,
    };
    const kind = JSON.stringify({ ...body, time: speed ? 0 : body.time });
    if (kind === this.sent && !(speed && performance.now() - this.at > AGAIN)) return;
    [this.sent, this.at, this.wanted] = [kind, performance.now(), body];
    this.send();
  }

  // The live scene again.
  leave() {
    if (!this.isThere || !this.sent) return;
    this.sent = "";
    this.wanted = { view: this.key, episode_ids: [] };
    this.send();
  }

  // One request at a time; of those that wait only the newest is sent.
  async send() {
    if (this.isBusy) return;
    this.isBusy = true;
    while (this.wanted) {
      const body = this.wanted;
      this.wanted = null;
      try {
        await this.api.put("/view", body);
      } catch (error) {
        if (error.status === 404) this.key = null; // that page has gone
      }
    }
    this.isBusy = false;
  }
}
