// The shape in the view Socket: its face coloured by offset, areas placed by clicks and written into the study file.
import { el, replace } from "/static/dom.js";
import { readArrays } from "/web/arrays.js";
import { labelled } from "/static/views/parts.js";
import { TrimHandles } from "/static/views/socket_trim.js";

const FACE = "#b9c2cc", PRESSED = "#d55e00", RELIEVED = "#0072b2", DRAFT = "#cc79a7";
const NEW = { position_mm: null, region: null, radius_mm: 25, depth_mm: 3 };

export class ShapeEditor {
  /** view: has context, viewer (or none), frame, map(). */
  constructor(view) {
    Object.assign(this, { view, shape: null, chosen: null, draft: null, read: null, turn: 0 });
    this.state = el("p", { class: "hint socket-shape-words" });
    this.list = el("ul", { class: "plain site-list" });
    this.adder = el("button", { type: "button", onclick: () => this.begin({ ...NEW, name: this.nextName(), fresh: true }) }, "Add an area");
    this.form = el("div", { class: "site-form" });
    this.trim = new TrimHandles(view, (path, values, text) => this.send(path, values, text));
    this.part = el("div", {}, this.state, this.trim.part, el("h2", {}, "Areas"), this.list, el("div", { class: "row" }, this.adder), this.form);
  }

  /** Show a shape of the server; its face is read where it is another one. */
  async take(shape) {
    const turn = ++this.turn, { viewer } = this.view;
    this.shape = shape;
    this.tell();
    this.build();
    if (!viewer) return;
    if (shape.problem) {
      this.read = null;
      viewer.setMesh(null);
      viewer.setColours(null);
    } else if (this.read !== shape.mark) {
      const { arrays } = readArrays(await this.view.context.api.bytes("socket/face"));
      if (turn !== this.turn) return;
      this.draw(arrays);
      this.read = shape.mark;
    }
    this.trim.take(shape);
    this.marks();
  }

  /** The face as a mesh whose every triangle is a cell of its own, so that it is coloured as one. */
  draw({ points, faces, values }) {
    const { viewer } = this.view, count = faces.values.length / 3, first = !this.values;
    const mesh = {
      points: points.values, faces: faces.values, cells: new Uint32Array(0), regions: new Uint8Array(count),
      owners: Uint32Array.from({ length: count }, (_, i) => i), neighbours: new Int32Array(count).fill(-1),
    };
    this.values = values.values;
    viewer.setMesh(mesh, [FACE]);
    viewer.setStyle({ edged: false });
    this.paint();
    viewer.setMoment({ on: "nodes", values: this.values }, null);
    if (first) viewer.lookAtAll(this.view.frame);
  }

  paint() {
    if (!this.values) return;
    const sorted = Float32Array.from(this.values, Math.abs).sort();
    const most = Math.max(sorted[Math.floor(0.98 * (sorted.length - 1))], 0.1); // the brim turns far out
    const beyond = sorted.at(-1) > most;
    this.view.viewer?.setColours({ map: this.view.map(), low: -most, high: most, beyond: [beyond, beyond], title: "offset (mm), negative: pressed in" });
  }

  /** Forget what is drawn: another picture takes its place. */
  leave() {
    this.turn++;
    Object.assign(this, { read: null, values: null, draft: null });
    if (this.view.viewer) this.trim.clear();
    if (this.view.viewer) Object.assign(this.view.viewer, { placing: false });
  }

  tell() {
    const { shape } = this, from = shape.file ? `read from ${shape.file}: areas do not change it` : `${shape.reduction_percent} % less around than the limb`;
    this.state.textContent = shape.problem ?? `The face, ${from}; ${shape.volume_cm3.toFixed(0)} cm³. Drawn around the bare skin; a liner comes between.`;
    this.state.className = shape.problem ? "doubt socket-shape-words" : "hint socket-shape-words";
    this.adder.disabled = Boolean(shape.file);
  }

  build() {
    const { areas } = this.shape;
    replace(this.list, ...areas.map((area) => el("li", {},
      el("button", { type: "button", class: "quiet site", "aria-pressed": String(area.name === this.chosen), onclick: () => this.choose(area.name) },
        el("strong", {}, area.name), el("span", { class: "region" }, area.region ?? ""),
        el("span", { class: "hint" }, `${area.depth_mm} mm, radius ${area.radius_mm}`)))));
    this.showForm();
  }

  choose(name) {
    const area = this.shape.areas.find((one) => one.name === name);
    if (area) this.begin({ ...area, fresh: false });
  }

  begin(draft) {
    this.chosen = draft.fresh ? null : draft.name;
    this.set(draft);
    if (draft.fresh) this.view.context.say("Click on the face where the area is, or choose a region.");
  }

  set(draft) {
    this.draft = draft;
    if (this.view.viewer) this.view.viewer.placing = draft !== null;
    this.build();
    this.marks();
  }

  /** A click on the face. */
  placed(point) {
    if (!this.draft) return;
    Object.assign(this.draft, { position_mm: point, region: null });
    this.showForm();
    this.marks();
  }

  nextName() {
    const taken = new Set(this.shape.areas.map((area) => area.name));
    let i = 1;
    while (taken.has(`area ${i}`)) i++;
    return `area ${i}`;
  }

  showForm() {
    const { draft } = this;
    if (!draft) return replace(this.form);
    const number = (key, low, high) => el("input", { type: "number", step: "0.5", min: low, max: high, name: key, value: draft[key],
      oninput: (event) => { draft[key] = Number.parseFloat(event.target.value); } });
    const name = el("input", { name: "name", maxlength: "40", value: draft.name, disabled: !draft.fresh, oninput: () => { draft.name = name.value.trim(); } });
    const region = el("select", { name: "region", onchange: () => { draft.region = region.value || null; if (draft.region) draft.position_mm = null; this.showForm(); this.marks(); } },
      el("option", { value: "" }, "where clicked"), ...this.shape.regions.map((one) => el("option", { value: one }, one)));
    region.value = draft.region ?? "";
    const place = draft.region ? `at the middle of ${draft.region}` : draft.position_mm
      ? `at ${draft.position_mm.map((x) => x.toFixed(1).replace("-", "−")).join(", ")} mm (LPS)` : "Click on the face where the area is.";
    replace(this.form, el("form", { onsubmit: (event) => { event.preventDefault(); this.save(); } },
      el("h3", {}, draft.fresh ? "New area" : draft.name), labelled("name", name), labelled("place", region), el("p", { class: "hint" }, place),
      labelled("radius (mm)", number("radius_mm", 3, 150)), labelled("depth (mm), negative: relief", number("depth_mm", -20, 20)),
      el("div", { class: "row" }, el("button", { type: "submit", class: "main" }, "Save"),
        draft.fresh ? null : el("button", { type: "button", onclick: () => this.remove() }, "Remove"),
        el("button", { type: "button", onclick: () => { this.chosen = null; this.set(null); } }, "Cancel"))));
  }

  save() {
    const { name, position_mm: position, region, radius_mm, depth_mm } = this.draft;
    if (!position && !region) return this.view.context.say("Click on the face, or choose a region, to say where the area is.");
    const place = region ? { region } : { position };
    return this.send("socket/areas", { name, ...place, radius_mm, depth_mm }, `Area ${name} is in the study.`);
  }

  remove() {
    const { name } = this.draft;
    return this.send(`socket/areas/${encodeURIComponent(name)}/remove`, {}, `Area ${name} is no longer in the study.`);
  }

  async send(path, values, text) {
    const { context } = this.view;
    try {
      const shape = await context.api.post(path, values);
      this.chosen = null;
      this.set(null);
      await this.take(shape);
      context.say(text);
      context.refresh();
      return true;
    } catch (error) {
      context.warn(error.message);
      return false;
    }
  }

  marks() {
    const { viewer, frame } = this.view;
    if (!viewer || !this.shape) return;
    this.trim.aside(Boolean(this.draft));
    const inward = (point) => {
      const up = frame[2], from = viewer.view.home.target.map((value, k) => value - point[k]);
      const along = from.reduce((sum, value, k) => sum + value * up[k], 0);
      const flat = from.map((value, k) => value - along * up[k]), size = Math.hypot(...flat) || 1;
      return flat.map((value) => value / size);
    };
    const shown = this.shape.areas.filter((area) => area.position_mm && area.name !== this.draft?.name);
    const sites = shown.map((area) => ({
      name: area.name, at: area.position_mm, axis: inward(area.position_mm), filled: true, colour: area.depth_mm < 0 ? RELIEVED : PRESSED,
    }));
    const { draft } = this;
    if (draft?.position_mm) sites.push({ name: draft.name, at: draft.position_mm, axis: inward(draft.position_mm), filled: true, colour: DRAFT, chosen: true });
    viewer.setSites(sites);
  }
}
