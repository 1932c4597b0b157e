// One picture of the view Socket: a stored run, the limb coloured by what the socket does to it at a step.
import { el } from "/static/dom.js";
import { readArrays } from "/web/arrays.js";
import { mapBytes, shortNumber } from "/web/colours.js";
import { canDraw, Viewer } from "/web/viewer.js";
import { loadMesh, NO_WEBGL, REGION_COLOURS } from "/static/views/parts.js";

const OUTSIDE_MM = 8, NOT_COMPARED = "#8a8a8a";

export class Pane {
  constructor(host, context) {
    Object.assign(this, { context, turn: 0, run: null, frames: [] });
    this.stage = el("div", { class: "player-stage" });
    host.append(this.stage);
    if (canDraw()) this.viewer = new Viewer(this.stage, "The limb coloured by what the socket does to it.");
    else this.stage.append(el("p", { class: "padded failed" }, NO_WEBGL));
  }

  close() {
    this.turn++;
    this.viewer?.close();
    this.stage.remove();
  }

  clear() {
    this.turn++;
    Object.assign(this, { run: null, mesh: null, frames: [], step: null, values: null });
    this.viewer?.setMesh(null);
    this.viewer?.setColours(null);
    this.viewer?.setSites([]);
  }

  /** A run with a field at all of its steps; false where something else was asked for meanwhile. */
  async load(run, frame) {
    this.clear();
    const turn = this.turn;
    const { mesh, arrays, facts } = await loadMesh(this.context, `socket/mesh/${encodeURIComponent(run.run)}`);
    if (turn !== this.turn) return false;
    Object.assign(this, { run, mesh, place: arrays.place.values, places: facts.places });
    this.viewer?.setMesh(mesh, facts.regions.map((_, i) => REGION_COLOURS(i, facts.regions.length)));
    this.viewer?.setStyle({ edged: false });
    this.viewer?.lookAtAll(frame);
    return true;
  }

  async read(field) {
    const turn = this.turn, path = `socket/step/${encodeURIComponent(this.run.run)}`;
    const frames = await Promise.all(this.run.steps.map(async (_, at) =>
      readArrays(await this.context.api.bytes(`${path}/${at}/${field}`)).arrays.values.values));
    if (turn === this.turn) this.frames = frames;
  }

  get high() {
    return Math.max(0, ...this.frames.map(largest));
  }

  scale(map, high, title) {
    this.shared = high;
    this.viewer?.setColours({ map, low: 0, high, beyond: [false, false], title });
  }

  /** Colour the limb by a step; what is to be said of it, or nothing. */
  show(name, at, what) {
    const found = this.run?.steps.findIndex((step) => step.name === name) ?? -1;
    const here = found < 0 ? Math.min(at, this.frames.length - 1) : found;
    const step = this.run?.steps[here], values = this.frames[here];
    if (!values) return null;
    Object.assign(this, { step, values });
    this.viewer?.setMoment({ on: "nodes", values }, null);
    const settled = typeof step.settling_mm === "number" ? `; settles by ${step.settling_mm.toFixed(1)} mm` : "";
    return `${step.name}; ${what} at most ${shortNumber(largest(values))} kPa at a node${settled}`;
  }

  /** Cells of sensors outside of the limb in the colours of a quantity, `difference` for model minus measured; what the colours mean, in words. */
  showCells(cells, what, map, high, chosen) {
    if (!this.viewer) return "";
    const middle = [0, 1, 2].map((k) => mean(this.mesh.points.filter((_, i) => i % 3 === k)));
    const most = largest(cells.filter(isCompared).map((cell) => Math.abs(cell.model_kPa - cell.measured_kPa)));
    const bytes = mapBytes(map);
    const paint = (cell) => {
      if (!isCompared(cell)) return NOT_COMPARED;
      if (what === "difference") return diverging((cell.model_kPa - cell.measured_kPa) / (most || 1));
      const at = 4 * Math.round(255 * Math.min(1, cell[what] / (high || 1)));
      return hex([...bytes.slice(at, at + 3)]);
    };
    const marks = cells.map((cell) => {
      const inward = [middle[0] - cell.position_mm[0], middle[1] - cell.position_mm[1], 0];
      const axis = inward.map((value) => value / (Math.hypot(...inward) || 1));
      const at = cell.position_mm.map((value, k) => value - OUTSIDE_MM * axis[k]);
      return { name: cell.cell, at, axis, colour: paint(cell), filled: isCompared(cell), chosen: cell === chosen };
    });
    this.viewer.setSites(marks, 3);
    this.viewer.overlay.showSites(false);
    if (!cells.length) return "";
    const others = cells.some((cell) => !isCompared(cell)) ? "; grey rings are not compared" : "";
    return what === "difference" ? `blue to red: model minus measured, −${shortNumber(most)} to ${shortNumber(most)} kPa${others}` : `in the colours of the bar${others}`;
  }

  /** What the node nearest to the pointer bears, in words. */
  pointed(event, what) {
    const hit = this.values && this.mesh && this.viewer.meshAt(event);
    if (!hit) return "";
    const { points } = this.mesh;
    let node = 0, near = Infinity;
    for (let i = 0; i < points.length / 3; i++) {
      const far = (points[3 * i] - hit[0]) ** 2 + (points[3 * i + 1] - hit[1]) ** 2 + (points[3 * i + 2] - hit[2]) ** 2;
      if (far < near) [node, near] = [i, far];
    }
    const place = this.places[this.place[node]] || "no region";
    return `${what} ${shortNumber(this.values[node])} kPa; ${place}`;
  }
}

/** Two pictures that turn, move and grow together. */
export function link(one, other) {
  let following = false;
  for (const [from, to] of [[one, other], [other, one]]) {
    const changed = from.view.changed;
    from.view.changed = () => {
      changed();
      if (following) return;
      following = true;
      const { target, half, azimuth, elevation } = from.view;
      Object.assign(to.view, { target: [...target], half, azimuth, elevation });
      to.view.update();
      following = false;
    };
  }
  one.view.update();
}

const isCompared = (cell) => cell.state === "compared";
const hex = (bytes) => `#${bytes.map((value) => Math.round(value).toString(16).padStart(2, "0")).join("")}`;
const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

/** From blue at -1 over white to red at 1. */
function diverging(share) {
  const end = share < 0 ? [33, 102, 172] : [178, 24, 43];
  return hex(end.map((value) => 247 + Math.abs(share) * (value - 247)));
}

function largest(values) {
  return values.reduce((most, value) => Math.max(most, value), 0);
}
