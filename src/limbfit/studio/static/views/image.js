// The view Image: slices and 3-D by niivue, labels painted on top and saved into the study.
import { el, replace } from "/static/dom.js";
import { canDraw } from "/web/viewer.js";
import { NO_WEBGL, runButton } from "/static/views/parts.js";

const LAYOUTS = [["all", "All"], ["axial", "Axial"], ["coronal", "Coronal"], ["sagittal", "Sagittal"], ["render", "3-D"]];
const STEPS = { ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0], PageUp: [0, 0, 1], PageDown: [0, 0, -1] };

export function mount(element, context) {
  const view = new ImageView(element, context);
  view.refresh();
  context.on((changed) => (changed.labels || (changed.study && element.dataset.state !== "ready")) && view.refresh());
  context.on((changed) => changed.theme && view.viewer && view.colours());
  return { show: () => view.wake(), hide: () => view.sleep() };
}

class ImageView {
  constructor(element, context) {
    Object.assign(this, { element, context });
    this.strokes = [];
    this.pen = null;
    this.canvas = el("canvas", { id: "slices", tabindex: 0, "aria-describedby": "slice-keys",
      "aria-label": "Slices of the image and the limb in 3-D" });
    this.place = el("p", { class: "hint", id: "place", "aria-live": "off" });
    this.side = el("div", { class: "side" });
    const area = el("div", { class: "stagearea imagearea" }, this.canvas, this.place);
    element.append(this.side, area);
    this.canvas.addEventListener("keydown", (event) => this.key(event));
  }

  refresh() {
    return this.context.load(this.element, "the image", () => this.read());
  }

  async read() {
    const facts = await this.context.api.get("image");
    this.element.classList.toggle("split", facts.has_image);
    if (!facts.has_image) {
      const model = el("button", { type: "button", onclick: () => (location.hash = "#/model") }, "Show the limb");
      return { text: "This study starts from surfaces: it has no image.", actions: [model] };
    }
    if (!canDraw()) return { text: NO_WEBGL };
    const first = !this.opened;
    this.opened ??= this.open(facts);
    try {
      await this.opened;
    } catch (error) {
      this.opened = null;
      throw error;
    }
    if (!first) await this.labelsChanged(facts);
  }

  async open(facts) {
    const { api } = this.context;
    const [library, image] = await Promise.all([import("/static/vendor/niivue.js"), api.bytes("image/volume")]);
    const { Niivue, NVImage, SHOW_RENDER, MULTIPLANAR_TYPE, SLICE_TYPE } = library;
    [this.types, this.NVImage, this.NVMesh] = [SLICE_TYPE, NVImage, library.NVMesh];
    this.viewer = new Niivue({
      logLevel: "error", dragAndDropEnabled: false, isResizeCanvas: true, multiplanarShowRender: SHOW_RENDER.ALWAYS,
      multiplanarLayout: MULTIPLANAR_TYPE.GRID, multiplanarEqualSize: false, show3Dcrosshair: false, crosshairWidth: 0.35,
      meshThicknessOn2D: 0, isOrientCube: false, tileMargin: 4, viewModeHotKey: "", clipPlaneHotKey: "",
      cycleClipPlaneHotKey: "", isRadiologicalConvention: true, loadingText: "", maxDrawUndoBitmaps: 1,
      fontColor: [1, 1, 1, 1], fontMinPx: 16, showAllOrientationMarkers: true,
    });
    await this.viewer.attachToCanvas(this.canvas, false);
    this.colours();
    this.onlySurfaces(facts.surfaces);
    const volume = await NVImage.loadFromFile({ file: new File([image], "image.nii") });
    this.range = [volume.global_min, volume.global_max];
    this.auto = [volume.cal_min, volume.cal_max];
    await this.atOnce(async () => {
      this.viewer.addVolume(volume);
      await this.showLabels(facts);
      this.controls();
      this.layout("all");
    });
    this.viewer.onLocationChange = (at) => this.tellPlace(at);
    this.viewer.onDrawingChanged = (action) => action === "draw" && this.stroke();
    this.viewer.createOnLocationChange();
    await this.surfaces(facts.surfaces);
  }

  /** Nothing is drawn on a canvas without a size. */
  sleep() {
    if (this.viewer) this.viewer.drawScene = () => {};
  }

  wake() {
    if (!this.viewer) return;
    delete this.viewer.drawScene;
    this.viewer.resizeListener();
  }

  /** Many changes, drawn once. */
  async atOnce(change) {
    this.viewer.drawScene = () => {};
    try {
      await change();
    } finally {
      if (this.canvas.clientWidth) delete this.viewer.drawScene;
    }
    this.viewer.drawScene();
  }

  colours() {
    const dark = document.documentElement.dataset.theme === "dark";
    this.viewer.opts.backColor = dark ? [0.05, 0.06, 0.07, 1] : [0.13, 0.14, 0.16, 1];
    this.viewer.opts.crosshairColor = [0.94, 0.89, 0.26, 0.9];
    this.viewer.drawScene?.();
  }

  // --- labels ---------------------------------------------------------------------------------------------

  async showLabels(facts) {
    this.facts = facts;
    if (!facts.labels) return;
    const bytes = await this.context.api.bytes("image/labels");
    const image = await this.NVImage.loadFromFile({ file: new File([bytes], "labels.nii") });
    if (!this.viewer.loadDrawing(image)) {
      this.context.warn("The labels are not on the grid of the image: run the stage segment again.");
      this.facts = { ...facts, labels: null };
      return;
    }
    this.saved = this.viewer.drawBitmap.slice();
    this.before = this.saved.slice();
    this.strokes = [];
    const lut = { R: [0], G: [0], B: [0], A: [0], labels: ["outside"] };
    for (let value = 1; value < 256; value++) {
      const row = facts.labels.names.find((one) => one.value === value);
      const colour = row?.colour ?? "#ff0000";
      ["R", "G", "B"].forEach((key, i) => lut[key].push(parseInt(colour.slice(1 + 2 * i, 3 + 2 * i), 16)));
      lut.A.push(255);
      lut.labels.push(row?.name ?? "");
    }
    this.viewer.setDrawColormap(lut);
    this.viewer.setDrawOpacity(0.35);
  }

  /** Someone else (a run, another tab, 3D Slicer) wrote the labels. */
  async labelsChanged(facts) {
    if (facts.labels?.base === this.facts.labels?.base) return;
    if (this.strokes.length) {
      this.context.warn("The labels were changed elsewhere while you painted: they can no longer be saved from here. Use “Start again” to see the new ones.");
      return;
    }
    await this.showLabels(facts);
    this.controls();
    await this.surfaces(facts.surfaces);
  }

  stroke() {
    const now = this.viewer.drawBitmap;
    const only = this.over === "" ? null : Number(this.over);
    const at = [], was = [], is = [];
    for (let i = 0; i < now.length; i++) {
      if (now[i] === this.before[i]) continue;
      if (only !== null && this.before[i] !== only) now[i] = this.before[i];
      else at.push(i), was.push(this.before[i]), is.push(now[i]), (this.before[i] = now[i]);
    }
    this.viewer.refreshDrawing(true);
    if (!at.length) return;
    this.strokes.push({ at, was, is });
    this.count();
  }

  undo() {
    const last = this.strokes.pop();
    if (!last) return;
    last.at.forEach((i, k) => (this.before[i] = last.was[k]));
    this.viewer.drawBitmap.set(this.before);
    this.viewer.refreshDrawing(true);
    this.count();
  }

  /** A disc in the axial plane at the crosshair, for those who paint by keyboard. */
  dab() {
    if (this.pen === null) return;
    const { viewer } = this;
    const [x, y, z] = viewer.frac2vox(viewer.scene.crosshairPos);
    const [, nx, ny, nz] = viewer.back.dimsRAS;
    const radius = (viewer.opts.penSize - 1) / 2;
    const reach = Math.floor(radius);
    for (let dy = -reach; dy <= reach; dy++) {
      for (let dx = -reach; dx <= reach; dx++) {
        const [i, j] = [x + dx, y + dy];
        if (dx * dx + dy * dy > radius * radius || i < 0 || j < 0 || i >= nx || j >= ny || z < 0 || z >= nz) continue;
        viewer.drawBitmap[i + nx * (j + ny * z)] = this.pen;
      }
    }
    this.stroke();
  }

  count() {
    const changed = new Set(this.strokes.flatMap((one) => one.at)).size;
    this.changes.textContent = changed ? `${changed.toLocaleString("en")} voxels painted, not saved yet` : "Nothing painted";
    this.save.disabled = this.back.disabled = this.again.disabled = !this.strokes.length;
  }

  runs() {
    const now = this.viewer.drawBitmap, runs = [];
    for (let i = 0; i < now.length; i++) {
      if (now[i] === this.saved[i]) continue;
      const last = runs.at(-1);
      if (last && last[0] + last[1] === i && last[2] === now[i]) last[1]++;
      else runs.push([i, 1, now[i]]);
    }
    return runs;
  }

  async keep() {
    const runs = this.runs();
    if (!runs.length) {
      this.strokes = [];
      this.count();
      return;
    }
    this.save.disabled = true;
    try {
      const done = await this.context.api.post("image/labels", { base: this.facts.labels.base, runs });
      this.facts.labels.base = done.base;
      this.saved = this.viewer.drawBitmap.slice();
      this.strokes = [];
      this.context.say(`Saved ${done.changed_voxels} voxels to ${done.saved_to}. Stages below the labels are stale now.`);
      this.context.refresh();
    } catch (error) {
      this.context.warn(`Not saved: ${error.message}`);
    }
    this.count();
  }

  // --- controls -------------------------------------------------------------------------------------------

  controls() {
    const slider = (id, text, value, low, high, step, change) => {
      const shown = el("output", { for: id }, String(Math.round(value)));
      const input = el("input", { type: "range", id, min: low, max: high, step, value,
        oninput: () => { shown.textContent = String(Math.round(input.value)); change(Number(input.value)); } });
      return [input, el("div", { class: "field" }, el("label", { for: id }, text), shown, input)];
    };
    const [low, high] = this.range;
    const [a, b] = this.auto;
    const step = Math.max((high - low) / 500, 1e-3);
    const [level, levelRow] = slider("level", "Level (grey value)", (a + b) / 2, low, high, step, () => this.window());
    const [width, widthRow] = slider("width", "Window (grey values)", b - a, step, (high - low) || 1, step, () => this.window());
    this.sliders = { level, width };
    const layouts = LAYOUTS.map(([key, text]) => el("button", { type: "button", class: "tiny", "aria-pressed": "false", id: `layout-${key}`, onclick: () => this.layout(key) }, text));
    replace(this.side,
      el("h2", {}, "View"),
      el("div", { class: "row", role: "group", "aria-label": "Planes" }, layouts),
      levelRow, widthRow,
      el("div", { class: "row" }, el("button", { type: "button", onclick: () => this.window(this.auto) }, "Automatic window")),
      ...this.paintControls(slider),
      el("p", { class: "hint", id: "slice-keys" }, "Wheel or Page Up/Down: slices. Arrow keys: crosshair. Right drag: window. P paints at the crosshair, Ctrl+Z takes back."));
    if (this.facts.labels) this.count();
    this.layout(this.shown ?? "all");
  }

  paintControls(slider) {
    if (!this.facts.labels) return [el("h2", {}, "Labels"), el("p", {}, "There are no labels yet."), runButton(this.context, "segment")];
    const names = this.facts.labels.names;
    const choose = (value, text, colour) => {
      const swatch = colour ? el("span", { class: "swatch" }) : null;
      if (swatch) swatch.style.background = colour;
      return el("label", { class: "row choice" },
        el("input", { type: "radio", name: "pen", value: String(value), checked: this.pen === value, onchange: () => this.take(value) }), swatch, text);
    };
    this.changes = el("p", { class: "hint", id: "changes", role: "status" });
    this.save = el("button", { type: "button", class: "main", id: "save-labels", onclick: () => this.keep() }, "Save labels");
    this.back = el("button", { type: "button", id: "undo", onclick: () => this.undo() }, "Undo");
    this.again = el("button", { type: "button", id: "again", onclick: () => this.restart() }, "Start again");
    const over = el("select", { id: "over", onchange: () => (this.over = over.value) }, el("option", { value: "" }, "everything"),
      names.map((row) => el("option", { value: String(row.value) }, `only ${row.name}`)), el("option", { value: "0" }, "only outside"));
    over.value = this.over ??= "";
    return [
      el("h2", {}, "Labels"),
      el("div", { class: "row" }, this.save, this.back, this.again),
      this.changes,
      slider("opacity", "Opacity (%)", 35, 0, 100, 5, (value) => this.viewer.setDrawOpacity(value / 100))[1],
      el("fieldset", {}, el("legend", {}, "Pen"), choose(null, "none: look only"),
        names.map((row) => choose(row.value, row.name, row.colour)), choose(0, "outside (erase)", "#000000")),
      slider("pen-size", "Pen size (voxels)", this.viewer.opts.penSize, 1, 21, 2, (value) => (this.viewer.opts.penSize = value))[1],
      el("div", { class: "field" }, el("label", { for: "over" }, "Paint over"), over),
      el("p", { class: "hint" }, `Saved to ${this.facts.labels.saved_to}; what was made from the labels turns stale.`),
    ];
  }

  take(value) {
    this.pen = value;
    if (value !== null) this.viewer.setPenValue(value, false);
    this.viewer.setDrawingEnabled(value !== null);
  }

  async restart() {
    await this.showLabels(await this.context.api.get("image"));
    this.take(this.pen);
    this.controls();
  }

  window(limits) {
    const { level, width } = this.sliders;
    if (limits) {
      level.value = (limits[0] + limits[1]) / 2;
      width.value = limits[1] - limits[0];
      for (const input of [level, width]) input.dispatchEvent(new Event("input"));
      return;
    }
    const [volume] = this.viewer.volumes;
    volume.cal_min = Number(level.value) - Number(width.value) / 2;
    volume.cal_max = Number(level.value) + Number(width.value) / 2;
    this.viewer.updateGLVolume();
  }

  layout(key) {
    this.shown = key;
    const types = { all: this.types.MULTIPLANAR, axial: this.types.AXIAL, coronal: this.types.CORONAL, sagittal: this.types.SAGITTAL, render: this.types.RENDER };
    this.viewer.setSliceType(types[key]);
    for (const [name] of LAYOUTS) document.getElementById(`layout-${name}`)?.setAttribute("aria-pressed", String(name === key));
  }

  /** Surfaces say more than a cloud of voxels, and software WebGL draws them a hundred times faster. */
  onlySurfaces(names) {
    if (names.length) this.viewer.drawImage3D = () => {};
    else delete this.viewer.drawImage3D;
  }

  async surfaces(names) {
    this.onlySurfaces(names);
    const files = await Promise.all(names.map((name) => this.context.api.bytes(`image/surfaces/${encodeURIComponent(name)}`)));
    await this.atOnce(async () => {
      for (const mesh of [...this.viewer.meshes]) this.viewer.removeMesh(mesh);
      for (const [i, name] of names.entries()) {
        const label = this.facts.labels?.names.find((row) => `bone-${row.name}.stl` === name);
        const colour = (label?.colour ?? "#d9a58f").slice(1).match(/../g).map((part) => parseInt(part, 16));
        const opacity = name === "skin.stl" ? 0.25 : 1;
        this.viewer.addMesh(await this.NVMesh.loadFromFile({ file: new File([files[i]], name), gl: this.viewer.gl, name, opacity, rgba255: [...colour, 255] }));
      }
    });
  }

  tellPlace(at) {
    const [x, y, z] = at.mm;
    const label = this.before?.[at.vox[0] + this.viewer.back.dimsRAS[1] * (at.vox[1] + this.viewer.back.dimsRAS[2] * at.vox[2])];
    const name = this.facts.labels?.names.find((row) => row.value === label)?.name ?? "outside";
    const value = at.values[0]?.value;
    const mm = [-x, -y, z].map((part) => part.toFixed(1).replace("-", "−")).join(", ");
    this.place.textContent = `LPS ${mm} mm · grey value ${value === undefined ? "–" : Number(value.toPrecision(4))}${this.facts.labels ? ` · ${name}` : ""}`;
  }

  key(event) {
    const undo = (event.ctrlKey || event.metaKey) && event.key === "z";
    if (undo) this.undo();
    else if (event.key === "p" || event.key === "P") this.dab();
    else if (STEPS[event.key]) this.viewer.moveCrosshairInVox(...STEPS[event.key]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}
