// The view Model: the limb in three dimensions, its meshes cut and judged, its sites added, moved and named.
import { el, replace } from "/static/dom.js";
import { readArrays } from "/web/arrays.js";
import { canDraw, Viewer } from "/web/viewer.js";
import { cutPanel, FITTED, HELD_OUT, labelled, loadMesh, NAVIGATION, NO_WEBGL, REGION_COLOURS, runButton, SIDES } from "/static/views/parts.js";
import { SiteEditor } from "/static/views/sites.js";

const DRAFT = "#cc79a7";
const SURFACES = { skin: { colour: "#d9a07c", opacity: 0.4 }, bone: { colour: "#e9e6dc", opacity: 1 }, layer: { colour: "#c8a13a", opacity: 0.5 } };
const QUALITIES = {
  "": null,
  min_dihedral_deg: { title: "smallest dihedral angle (°)", low: 0, high: 60 },
  scaled_jacobian: { title: "scaled Jacobian (–)", low: 0, high: 1 },
  volume_mm3: { title: "volume of a cell (mm³)" },
};

export function mount(element, context) {
  const view = new ModelView(element, context);
  view.refresh();
  context.on((changed) => (changed.study || changed.stages) && view.refresh());
  return { show: () => view.viewer?.resize() };
}

class ModelView {
  constructor(element, context) {
    Object.assign(this, { element, context, scene: null, chosen: null, shapes: new Map(), meshOf: null, reading: 0 });
    element.classList.add("split");
    this.side = el("div", { class: "side", tabindex: "0", role: "region", "aria-label": "Settings of the model" });
    this.stage = el("div", { class: "stagearea model-stage" });
    element.append(this.side, this.stage);
    this.drawing = canDraw();
    if (this.drawing) {
      this.viewer = new Viewer(this.stage, "The limb in three dimensions with its sites.");
      this.viewer.onSite = (name) => this.choose(name);
      this.viewer.onSurface = (hit) => this.editor.placed(hit.point);
    }
    this.editor = new SiteEditor(this);
    this.run = runButton(context, "surfaces");
    this.build();
  }

  build() {
    this.shown = el("div", { class: "row" });
    this.meshBox = el("input", { type: "checkbox", onchange: () => this.showMesh() });
    this.colour = el("select", { onchange: () => this.paint() },
      ...Object.entries(QUALITIES).map(([key, one]) => el("option", { value: key }, one ? one.title : "tissue")));
    this.map = el("select", { onchange: () => this.paint() }, ...["viridis", "cividis"].map((name) => el("option", { value: name }, name)));
    this.edges = el("input", { type: "checkbox", checked: true, onchange: () => this.viewer?.setStyle({ edged: this.edges.checked }) });
    this.regions = el("div", { class: "row" });
    this.cut = cutPanel((plane) => this.viewer?.cutMesh(plane), (normal) => this.viewer?.view.lookAlong(normal.map((value) => -value)));
    this.meshPanel = el("div", {},
      labelled("colour by", this.colour), labelled("colours", this.map), this.regions,
      el("label", { class: "row" }, this.edges, "edges of cells"), this.cut.part, (this.facts = el("div", { class: "hint" })));
    const sides = SIDES.map(([name, azimuth]) => el("button", { type: "button", onclick: () => this.viewer?.view.side(azimuth) }, name));
    replace(this.side,
      this.editor.part,
      el("h2", {}, "Show"), this.shown,
      el("div", { class: "row", role: "group", "aria-label": "Side of the limb" }, sides,
        el("button", { type: "button", onclick: () => this.viewer?.view.reset() }, "reset")),
      el("p", { class: "hint" }, NAVIGATION),
      el("h2", {}, "Mesh"), el("label", { class: "row" }, this.meshBox, (this.meshTitle = el("span", {}, "mesh of the site"))), this.meshPanel);
    this.meshPanel.hidden = true;
  }

  refresh() {
    return this.context.load(this.element, "the model", () => this.read());
  }

  async read() {
    const turn = ++this.reading, scene = await this.context.api.get("model/scene");
    if (turn === this.reading) await this.take(scene, JSON.stringify(scene) === JSON.stringify(this.scene)); // else a newer one was asked for or taken
    if (!this.drawing) return { text: NO_WEBGL };
    if (!this.shapes.size) return { text: "There are no surfaces of the limb yet.", actions: [this.run] };
  }

  /**
   * Show a scene; surfaces and meshes are read where they are others than those that are shown. An unchanged scene
   * leaves the form of the sites alone: who is typing or clicking there would lose the click.
   */
  async take(scene, unchanged = false) {
    ++this.reading; // an older answer that is still under way is void
    this.scene = scene;
    if (!scene.sites.some((site) => site.name === this.chosen)) this.chosen = scene.sites[0]?.name ?? null;
    if (!unchanged) this.editor.show();
    this.marks();
    if (this.drawing) {
      await this.readSurfaces();
      if (this.shapes.size && !this.framed) this.viewer.lookAtAll(scene.frame);
      this.framed = this.shapes.size > 0;
    }
    this.showBoxes();
    await this.showMesh();
  }

  async readSurfaces() {
    const { surfaces, layers, meshes } = this.scene;
    const wanted = new Map(Object.entries(surfaces).map(([name, mark]) => [name, { kind: name === "skin" ? "skin" : "bone", path: `surface/${encodeURIComponent(name)}`, mark }]));
    const [meshed] = Object.keys(meshes);
    if (meshed) for (const layer of layers) wanted.set(`inner face of ${layer}`, { kind: "layer", path: `layer/${encodeURIComponent(meshed)}/${encodeURIComponent(layer)}`, mark: meshes[meshed] });
    for (const name of [...this.shapes.keys()]) {
      if (!wanted.has(name)) { this.viewer.setSurface(name, null); this.shapes.delete(name); }
    }
    for (const [name, one] of wanted) this.shapes.set(name, { shown: one.kind !== "layer", read: null, ...this.shapes.get(name), ...one });
    await this.readShown();
  }

  /** Surfaces that are shown and not read yet, or made anew. */
  async readShown() {
    await Promise.all([...this.shapes].filter(([, shape]) => shape.shown && shape.read !== shape.mark).map(async ([name, shape]) => {
      shape.read = shape.mark;
      try {
        const { arrays } = readArrays(await this.context.api.bytes(`model/${shape.path}`));
        this.viewer.setSurface(name, { points: arrays.points.values, faces: arrays.faces.values, ...SURFACES[shape.kind] });
      } catch (error) {
        shape.read = null;
        throw error;
      }
    }));
  }

  showBoxes() {
    replace(this.shown, ...[...this.shapes].map(([name, shape]) => {
      const box = el("input", { type: "checkbox", checked: shape.shown, onchange: () => this.showShape(shape, box.checked) });
      return el("label", { class: "row" }, box, name);
    }));
    this.showSurfaces();
  }

  async showShape(shape, shown) {
    shape.shown = shown;
    try {
      await this.readShown();
    } catch (error) {
      this.context.warn(error.message);
    }
    this.showSurfaces();
  }

  showSurfaces() {
    const meshed = this.meshBox.checked && this.meshOf;
    this.shown.hidden = Boolean(meshed); // the mesh stands in place of the surfaces
    for (const [name, shape] of this.shapes) this.viewer?.showSurface(name, shape.shown && !meshed);
  }

  marks() {
    if (!this.drawing) return;
    const sites = this.scene.sites.filter((site) => site.position_mm).map((site) => ({
      name: site.name, at: site.position_mm, axis: site.axis, filled: site.fitted, colour: site.fitted ? FITTED : HELD_OUT,
      chosen: site.name === this.chosen,
    }));
    const draft = this.editor.draft;
    if (draft) sites.push({ name: "new place", at: draft, axis: this.inward(draft), filled: true, colour: DRAFT, chosen: true });
    this.viewer.setSites(sites);
  }

  /** Roughly into the limb: towards its middle line. */
  inward(point) {
    const up = this.scene.frame[2], middle = this.viewer.view.home.target;
    const from = middle.map((value, k) => value - point[k]);
    const along = from.reduce((sum, value, k) => sum + value * up[k], 0);
    const flat = from.map((value, k) => value - along * up[k]), size = Math.hypot(...flat) || 1;
    return flat.map((value) => value / size);
  }

  choose(name, turn = false) {
    this.chosen = name;
    this.editor.show();
    this.marks();
    const site = this.site();
    if (turn && site?.axis && this.drawing && !this.meshBox.checked) this.viewer.view.lookAlong(site.axis);
    this.showMesh();
  }

  site() {
    return this.scene?.sites.find((site) => site.name === this.chosen);
  }

  async showMesh() {
    const mark = this.scene?.meshes[this.chosen], known = Boolean(mark);
    this.meshBox.disabled = !known || !this.drawing;
    this.meshTitle.textContent = known ? `mesh of site ${this.chosen}` : `no mesh of site ${this.chosen ?? "–"} is stored`;
    const wanted = known && this.meshBox.checked && this.drawing ? this.chosen : null;
    this.meshPanel.hidden = !wanted;
    if (wanted !== this.meshOf || (wanted && mark !== this.meshMark)) {
      [this.meshOf, this.meshMark] = [wanted, mark];
      this.viewer?.setMesh(null);
      this.viewer?.setColours(null);
      if (wanted) await this.readMesh(wanted);
    }
    this.showSurfaces();
  }

  async readMesh(name) {
    const { mesh, arrays, facts } = await loadMesh(this.context, `model/mesh/${encodeURIComponent(name)}`);
    if (this.meshOf !== name) return;
    this.cells = arrays;
    const colours = facts.regions.map((_, i) => REGION_COLOURS(i, facts.regions.length));
    this.viewer.setMesh(mesh, colours);
    this.viewer.setStyle({ edged: this.edges.checked });
    replace(this.regions, ...facts.regions.map((region, i) => {
      const box = el("input", { type: "checkbox", checked: true, onchange: () => this.viewer.showRegion(i, box.checked) });
      const swatch = el("span", { class: "swatch" });
      swatch.style.background = colours[i];
      return el("label", { class: "row" }, box, swatch, region);
    }));
    this.cut.set(mesh.points, this.scene.frame, this.site());
    this.paint();
    this.tellQuality(facts);
  }

  paint() {
    if (!this.viewer || !this.meshOf || !this.cells) return;
    const chosen = QUALITIES[this.colour.value];
    if (!chosen) {
      this.viewer.setColours(null);
      return this.viewer.setMoment(null, null);
    }
    const { values } = this.cells[this.colour.value];
    const sorted = Float32Array.from(values).sort();
    const low = chosen.low ?? 0, high = chosen.high ?? sorted[Math.floor(0.98 * (sorted.length - 1))];
    this.viewer.setColours({ map: this.map.value, low, high, beyond: [sorted[0] < low, sorted.at(-1) > high], title: chosen.title });
    this.viewer.setMoment({ on: "cells", values }, null);
  }

  tellQuality(facts) {
    const stored = this.scene.quality[this.meshOf] ?? {};
    const number = (value, digits, unit) => (typeof value === "number" ? `${value.toFixed(digits)} ${unit}` : "–");
    const rows = [
      `${facts.cells.toLocaleString("en")} cells (${facts.element}), ${(stored.nodes ?? 0).toLocaleString("en")} nodes`,
      `smallest dihedral angle ${number(stored.min_dihedral_deg, 1, "°")}`,
      `smallest scaled Jacobian ${number(stored.min_scaled_jacobian, 3, "")}`,
      ...(stored.warnings ?? []),
    ];
    replace(this.facts, ...rows.map((text) => el("p", {}, text)));
  }
}
