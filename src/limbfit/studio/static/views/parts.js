// Parts that views share.
import { el } from "/static/dom.js";
import { readArrays } from "/web/arrays.js";

export const NO_WEBGL = "This browser does not draw in three dimensions (no WebGL 2). Tables, curves and settings work; pictures of the limb are in the report.";
export const SIDES = [["anterior", 0], ["left", Math.PI / 2], ["posterior", Math.PI], ["right", -Math.PI / 2]];
export const FITTED = "#0072b2", HELD_OUT = "#d55e00"; // as the dots of the site list
export const NAVIGATION = "Drag turns the picture, Shift and drag moves it; the wheel enlarges once it was clicked.";
const BETWEEN = ["#7d6a2e", "#f7efce", "#4a6472"];

/** The colour of a tissue: layers, outermost first, what is inside the core, the core last; as in the report. */
export const REGION_COLOURS = (index, count) => (index === 0 ? "#e3c878" : index === count - 1 ? "#c8717a" : BETWEEN[(index - 1) % BETWEEN.length]);

/** A control with its label before it. */
export function labelled(text, control) {
  return el("label", { class: "field" }, text, control);
}

/** A button that runs the stages of the study until one of them, and shows how they go. */
export function runButton(context, until) {
  const start = async () => {
    try {
      await context.api.post("identification/start", { until });
    } catch (error) {
      return context.warn(error.message);
    }
    location.hash = "#/identification";
    context.refresh();
  };
  return el("button", { type: "button", class: "main", onclick: start }, `Run the stages until ${until}`);
}

/** A mesh of the server as viewer.js wants it, all its arrays, and its facts. */
export async function loadMesh(context, path) {
  const { arrays, facts } = readArrays(await context.api.bytes(path));
  const mesh = Object.fromEntries(
    ["points", "cells", "regions", "faces", "owners", "neighbours"].map((name) => [name, arrays[name].values]));
  return { mesh, arrays, facts };
}

const CUTS = { site: "along the limb, through the site", left: "from side to side", back: "from front to back", up: "across the limb" };

/**
 * The controls of a plane through a mesh. changed(plane or null) is called with {normal, offset, whole}, look(normal)
 * where the direction changed. Returns {part, set(points, frame, site)}.
 */
export function cutPanel(changed, look, { whole = true } = {}) {
  const state = { points: null, frame: null, site: null };
  const on = el("input", { type: "checkbox", checked: true, onchange: () => { turn(); apply(); } });
  const kind = el("select", { "aria-label": "direction of the cut", onchange: () => { place(); turn(); apply(); } },
    ...Object.entries(CUTS).map(([key, text]) => el("option", { value: key }, text)));
  const slider = el("input", { type: "range", min: "0", max: "1", step: "0.5", "aria-label": "place of the cut", oninput: () => apply() });
  const at = el("output", { class: "hint" });
  const flip = el("input", { type: "checkbox", onchange: () => { turn(); apply(); } });
  const cells = el("input", { type: "checkbox", checked: whole, onchange: () => apply() });
  const details = el("div", {}, kind, el("div", { class: "field" }, "place", at, slider),
    el("label", { class: "row" }, flip, "the other half"), el("label", { class: "row" }, cells, "whole cells"));
  let waiting = 0;

  const normal = () => {
    const { frame, site } = state;
    const base = { left: frame[0], back: frame[1], up: frame[2], site: crossed(site?.axis, frame) }[kind.value];
    return flip.checked ? base.map((value) => -value) : base;
  };

  /** Where the slider begins: at the site, or in the middle. */
  function place() {
    const direction = normal(), { points, site } = state;
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < points.length; i += 3) {
      const height = points[i] * direction[0] + points[i + 1] * direction[1] + points[i + 2] * direction[2];
      low = Math.min(low, height);
      high = Math.max(high, height);
    }
    const middle = site?.position_mm ? dot(site.position_mm, direction) : (low + high) / 2;
    const sign = flip.checked ? -1 : 1;
    [low, high] = sign < 0 ? [-high, -low] : [low, high];
    Object.assign(slider, { min: Math.floor(low), max: Math.ceil(high) });
    slider.value = sign * middle + 0.01;
  }

  function turn() {
    if (on.checked && state.points) look(normal());
  }

  function apply() {
    details.hidden = !on.checked;
    if (waiting || !state.points) return;
    waiting = requestAnimationFrame(() => {
      waiting = 0;
      const offset = Number(slider.value) * (flip.checked ? -1 : 1);
      at.textContent = `${Number(slider.value).toFixed(1)} mm`;
      changed(on.checked ? { normal: normal(), offset, whole: cells.checked } : null);
    });
  }

  return {
    turn,
    part: el("div", {}, el("label", { class: "row" }, on, "cut by a plane"), details),
    set(points, frame, site) {
      Object.assign(state, { points, frame, site });
      place();
      turn();
      apply();
    },
  };
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Normal to the plane that holds the limb's direction and the indenter's axis. */
function crossed(axis, frame) {
  const up = frame[2];
  if (!axis || Math.abs(dot(axis, up)) > 0.98) return frame[0];
  const found = [axis[1] * up[2] - axis[2] * up[1], axis[2] * up[0] - axis[0] * up[2], axis[0] * up[1] - axis[1] * up[0]];
  const size = Math.hypot(...found);
  return found.map((value) => value / size);
}
