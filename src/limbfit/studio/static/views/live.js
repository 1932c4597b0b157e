// The session that is being recorded: force over displacement and over time, read from its record as it grows.
// Nothing is commanded from here: the key and the emergency stop are the terminal's.
import { el, replace } from "/static/dom.js";
import { Chart } from "/web/chart.js";

const EVERY_MS = 200;
const SLOW_MS = 2000; // where nothing comes
const VERDICT_S = 20; // a session that is done is judged within less
const MOST_POINTS = 6000;
const HEIGHT = 300;
const RAMPS = ["load", "hold", "unload"];
const SEARCH = ["search", "return"];
const FORCE = { title: "Force", unit: "N" };
const MARKS = new Map([[true, "✓"], [false, "✗"], [null, "–"]]);

export class LivePanel {
  /** host: a hidden section; show(site) shows the record of a site. */
  constructor(host, context, show) {
    Object.assign(this, { host, context, showRecord: show, key: null, turn: 0, failures: 0, closed: new Set(), charts: [] });
  }

  /** Is something being recorded, or was it lately? */
  async look() {
    let session;
    try {
      ({ session } = await this.context.api.get("live"));
    } catch (error) {
      this.context.warn(error.message);
      return;
    }
    const key = session && `${encodeURIComponent(session.site)}/${encodeURIComponent(session.time)}`;
    if (!session || key === this.key || this.closed.has(key)) return;
    this.close();
    Object.assign(this, { key, session, offset: 0, failures: 0, phases: [], head: null, last: null, touch: null, ended: null, over: false, began: null });
    this.time = { x: [], y: [] };
    this.loops = { search: { x: [], y: [] }, ramps: { x: [], y: [] } };
    this.build();
    this.follow();
  }

  hide() {
    this.turn++;
  }

  show() {
    if (this.key && !this.over) this.follow();
  }

  close() {
    this.turn++;
    this.charts.forEach((chart) => chart.close());
    this.charts = [];
    this.host.hidden = true;
  }

  build() {
    const [loop, time] = [el("div", {}), el("div", {})];
    this.title = el("h2", {});
    this.now = el("p", { class: "row", id: "live-now" });
    this.note = el("p", { id: "live-note", hidden: true });
    this.checks = el("div", { id: "live-verdict" });
    const hint = "This page only looks: the key of the depth search and the emergency stop are those of the terminal that runs limbfit acquire, and the device's own button.";
    replace(this.host, this.title, this.now, this.note, this.checks, el("div", { class: "pair" }, loop, time), el("p", { class: "hint" }, hint));
    this.host.hidden = false;
    this.say("live", `Site ${this.session.site} is being recorded`);
    this.charts = [new Chart(loop, this.loopContent(), HEIGHT), new Chart(time, this.timeContent(), HEIGHT)];
  }

  say(state, title) {
    this.host.dataset.state = state;
    this.title.textContent = title;
  }

  async follow() {
    const turn = ++this.turn;
    while (turn === this.turn && !this.over) {
      let wait = EVERY_MS;
      try {
        const part = await this.context.api.get(`live/${this.key}?offset=${this.offset}`);
        if (turn !== this.turn) return;
        this.failures = 0;
        this.take(part);
        this.tell(part);
        this.draw(part.head !== null); // whose limit stands in the key
        wait = part.more ? 0 : part.silent ? SLOW_MS : EVERY_MS;
      } catch (error) {
        if (turn !== this.turn) return;
        if (++this.failures > 1) { // once may be in the middle of its first line
          this.say("failed", `Site ${this.session.site}: the record cannot be followed`);
          this.remark(error.message, "bad");
          wait = SLOW_MS;
        }
      }
      await new Promise((go) => setTimeout(go, document.hidden ? Math.max(wait, SLOW_MS) : wait));
    }
  }

  // --- what has come ------------------------------------------------------------------------------------

  take(part) {
    this.offset = part.offset;
    this.head ??= part.head;
    this.began ??= part.phases[0]?.at_s ?? part.time_s[0] ?? null;
    const before = this.phases.at(-1);
    this.phases.push(...part.phases);
    this.ended ??= part.ended;
    let k = Math.max(this.phases.length - part.phases.length - 1, 0);
    part.time_s.forEach((at, i) => {
      while (k + 1 < this.phases.length && this.phases[k + 1].at_s < at) k++; // what ends a phase belongs to it
      this.sample(this.phases[k], at - this.began, part.position_mm[i], part.force_N[i]);
    });
    const newest = this.phases.at(-1);
    if (newest && newest !== before && !part.more) this.context.say(`Site ${this.session.site}: ${this.words(newest)}`);
  }

  sample(phase, time, position, force) {
    const is = RAMPS.includes(phase?.phase) ? "ramps" : SEARCH.includes(phase?.phase) ? "search" : null;
    this.touch = phase?.touch_mm ?? this.touch;
    this.last = { time, force, depth: position - (this.touch ?? 0) };
    add(this.time, time, force);
    for (const [name, curve] of Object.entries(this.loops)) {
      if (name === is) add(curve, this.last.depth, force);
      else if (curve.y.length && curve.y.at(-1) !== null) add(curve, this.last.depth, null);
    }
  }

  words({ phase, cycle }) {
    return RAMPS.includes(phase) ? `${phase}, ramp ${cycle} of ${this.head?.ramps ?? "?"}` : phase;
  }

  // --- what is shown --------------------------------------------------------------------------------------

  tell(part) {
    const { site } = this.session;
    const phase = this.phases.at(-1);
    const { last } = this;
    replace(this.now, el("strong", {}, phase ? this.words(phase) : ""),
      last && !this.ended && el("output", {}, `${last.time.toFixed(1)} s, ${last.depth.toFixed(2)} mm from ${this.touch === null ? "home" : "touch"}, ${last.force.toFixed(2)} N of at most ${this.head.force_limit_N} N (pin ${this.head.pin})`));
    const age = part.age_s < 120 ? `${part.age_s.toFixed(0)} s` : `${(part.age_s / 60).toFixed(0)} min`;
    if (part.verdict) this.judged(part.verdict);
    else if (this.ended && this.ended.phase !== "done") {
      this.over = true;
      this.say("stopped", `Site ${site}: ${this.ended.phase === "unreachable" ? "stopped, and pins are out of reach" : "stopped"}`);
      this.remark(this.ended.reason, "bad");
    } else if (this.ended && part.age_s > VERDICT_S) {
      this.over = true;
      this.say("broken", `Site ${site}: recorded, but not judged`);
      this.remark("limbfit acquire ended before its verdict; limbfit recording judges the record.", "doubt");
    } else if (this.ended) this.say("live", `Site ${site}: the record is being judged`);
    else if (part.silent) {
      this.say("broken", `Site ${site}: the recording broke off`);
      this.remark(`No new sample for ${age}, and no end was recorded: limbfit acquire hangs or was killed. The device retracts by itself then; look at it.`, "bad");
    } else if (phase?.reason) this.remark(phase.reason, "bad");
    else {
      this.say("live", `Site ${site} is being recorded`);
      this.remark("");
    }
    if (this.over) this.note.append(" ", this.closer());
  }

  remark(text, kind = "") {
    this.note.hidden = !text;
    this.note.className = kind;
    if (this.note.textContent !== text) this.note.textContent = text;
  }

  judged(verdict) {
    const { site } = this.session;
    this.over = true;
    this.say("judged", `Site ${site}: recorded, the record is ${verdict.good ? "good" : "not good"}`);
    this.remark(verdict.good ? "" : "Record the site once more: limbfit acquire with --site and --again keeps this record beside the new one.", "bad");
    const rows = verdict.checks.map(({ name, passed, found, remedy }) =>
      el("li", { class: passed === false ? "bad" : passed ? "good" : "" }, `${MARKS.get(passed)} ${name}: ${found}${passed === false && remedy ? `; ${remedy}` : ""}`));
    const known = verdict.trace !== null && this.context.study?.sites.some((one) => one.name === site);
    const step = known && el("button", { type: "button", class: "main", id: "live-record", onclick: () => this.showRecord(site) }, `Show the record of site ${site}`);
    replace(this.checks, el("ul", { class: "plain" }, rows), el("p", { class: "row" }, step || "The study names no record of this site: the ramps lie beside the session's record.", this.closer()));
  }

  closer() {
    return el("button", { type: "button", onclick: () => { this.closed.add(this.key); this.key = null; this.close(); } }, "Close");
  }

  draw(anew = false) {
    const [loop, time] = this.charts;
    loop?.[anew ? "set" : "grow"](this.loopContent());
    time?.[anew ? "set" : "grow"](this.timeContent());
  }

  limit(xs) {
    const most = this.head?.force_limit_N ?? null;
    const seen = xs.flat();
    const ends = seen.length ? [seen.reduce((a, b) => Math.min(a, b)), seen.reduce((a, b) => Math.max(a, b))] : [0, 1];
    return { label: `limit ${most ?? ""} N: the session stops`, colour: "--bad", dash: "dashed", width: 1.5, x: ends, y: [most, most] };
  }

  loopContent() {
    const { search, ramps } = this.loops;
    return { label: `Force against displacement at site ${this.session.site}, as it is recorded.`, x: { title: "Displacement from touch", unit: "mm" }, y: FORCE,
      series: [{ label: "depth search", colour: "--muted", width: 1.5, ...search }, { label: "ramps", colour: "--simulated", width: 2.5, ...ramps }, this.limit([search.x, ramps.x])] };
  }

  timeContent() {
    return { label: `Force against time at site ${this.session.site}, as it is recorded.`, x: { title: "Time of the session", unit: "s" }, y: FORCE,
      series: [{ label: "test pin", colour: "--simulated", width: 2, ...this.time }, this.limit([this.time.x])] };
  }
}

/** A point more; where there are too many, every second one of the older half goes. */
function add(curve, x, y) {
  curve.x.push(x);
  curve.y.push(y);
  if (curve.x.length <= MOST_POINTS) return;
  const stays = (_, i) => i % 2 === 0 || i > MOST_POINTS / 2 || curve.y[i] === null;
  const [xs, ys] = [curve.x.filter(stays), curve.y.filter(stays)];
  Object.assign(curve, { x: xs, y: ys });
}
