// A limb in three dimensions: surfaces, sites, and a mesh that is cut, coloured and deformed. Lengths in mm, LPS.
import { OrbitCamera, CAMERA_KEYS } from "./camera.js";
import { Overlay, drawColourBar, element } from "./overlay.js";
import { mapBytes, mapGradient, shortNumber } from "./colours.js";
import { skinOf, valuesAt, vectorsAt } from "./volume.js";

const MESH_VERTEX = `
in vec3 moved; in vec3 tint; in float value; in float inside;
uniform float warp;
out vec3 rest; out vec3 place; out vec3 side; out vec3 colour; out float amount; out float within;
void main() {
  vec4 seen = modelViewMatrix * vec4(position + warp * moved, 1.0);
  rest = position; place = seen.xyz; colour = tint; amount = value; within = inside;
  int corner = gl_VertexID % 3;
  side = vec3(corner == 0, corner == 1, corner == 2);
  gl_Position = projectionMatrix * seen;
}`;
const MESH_FRAGMENT = `
precision highp float;
in vec3 rest; in vec3 place; in vec3 side; in vec3 colour; in float amount; in float within;
uniform vec4 plane; uniform bool cuts; uniform bool mapped; uniform bool edged; uniform vec2 range; uniform sampler2D map;
out vec4 painted;
void main() {
  if (cuts && within < 0.5 && dot(plane.xyz, rest) > plane.w + 1e-3) discard;
  vec3 shown = colour;
  if (mapped) shown = amount == amount ? texture(map, vec2((amount - range.x) / (range.y - range.x), 0.5)).rgb : vec3(0.5);
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  shown *= mix(mapped ? 0.8 : 0.55, 1.0, abs(normal.z));
  if (edged) {
    vec3 width = fwidth(side);
    vec3 far = smoothstep(vec3(0.0), 1.2 * width, side);
    shown = mix(shown, 0.25 * shown, 0.6 * (1.0 - min(far.x, min(far.y, far.z))));
  }
  painted = vec4(shown, 1.0);
}`;

/** Whether this browser draws in three dimensions. */
export function canDraw() {
  try {
    return Boolean(document.createElement("canvas").getContext("webgl2"));
  } catch {
    return false;
  }
}

export class Viewer {
  /** host: an empty element; label: what is seen, for who cannot see it. */
  constructor(host, label) {
    THREE.ColorManagement.enabled = false;
    this.host = host;
    host.classList.add("lf-viewer");
    this.canvas = element("canvas", { tabIndex: 0, className: "lf-canvas", role: "application" });
    this.canvas.setAttribute("aria-label", `${label} ${CAMERA_KEYS}`);
    this.bar = element("div", { className: "lf-bar", hidden: true });
    host.append(this.canvas, this.bar);
    this.overlay = new Overlay(host);
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = "srgb-linear";
    this.scene = new THREE.Scene();
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x999999, 1.9));
    this.lamp = new THREE.DirectionalLight(0xffffff, 1.5);
    this.scene.add(this.lamp, this.lamp.target);
    this.surfaces = new Map();
    this.paint = meshMaterial(); // kept, as those of the marks: a material made anew is compiled anew
    this.markPaints = new Map();
    this.sites = [];
    this.marks = new THREE.Group();
    this.scene.add(this.marks);
    this.view = new OrbitCamera(this.canvas, () => this.redraw());
    this.visible = [];
    this.canvas.addEventListener("pointerup", (event) => this.click(event));
    this.watcher = new ResizeObserver(() => this.resize());
    this.watcher.observe(host);
    this.resize();
  }

  /** Free what the graphics card holds; the viewer cannot be used after. */
  close() {
    this.watcher.disconnect();
    this.scene.traverse((part) => { part.geometry?.dispose(); part.material?.dispose(); });
    this.paint.uniforms.map.value?.dispose();
    for (const paint of [this.paint, ...this.markPaints.values()]) paint.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.host.replaceChildren();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.host;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.renderer.setSize(width, height, false);
    this.view.aspect = width / height;
    this.view.update();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = null;
      this.draw();
    });
  }

  draw() {
    const { camera } = this.view;
    this.lamp.position.copy(camera.position);
    this.lamp.target.position.set(...this.view.target);
    this.renderer.render(this.scene, camera);
    this.overlay.draw(this.view, this.host.clientWidth, this.host.clientHeight);
    this.drawn = (this.drawn ?? 0) + 1;
  }

  /** Look at all surfaces and the mesh; frame: rows left, back and up of the patient. */
  lookAtAll(frame) {
    const box = new THREE.Box3();
    for (const part of this.surfaces.values()) box.expandByObject(part);
    if (this.body) box.union(this.body.geometry.boundingBox);
    if (!box.isEmpty()) this.view.look({ low: box.min.toArray(), high: box.max.toArray() }, frame);
  }

  /** A surface by its name: {points, faces, colour, opacity}; null takes it away. */
  setSurface(name, surface) {
    this.drop(this.surfaces.get(name));
    this.surfaces.delete(name);
    if (surface) {
      const shape = new THREE.BufferGeometry();
      shape.setAttribute("position", new THREE.BufferAttribute(surface.points, 3));
      shape.setIndex(new THREE.BufferAttribute(surface.faces, 1));
      shape.computeVertexNormals();
      const clear = surface.opacity < 1;
      const part = new THREE.Mesh(shape, new THREE.MeshLambertMaterial({
        color: surface.colour, transparent: clear, opacity: surface.opacity, depthWrite: !clear, side: THREE.DoubleSide,
      }));
      part.renderOrder = clear ? 2 : 0;
      this.surfaces.set(name, part);
      this.scene.add(part);
    }
    this.redraw();
  }

  showSurface(name, shown) {
    const part = this.surfaces.get(name);
    if (part) part.visible = shown;
    this.redraw();
  }

  /** Sites: [{name, at, axis, colour, filled, chosen}]; axis points into the limb. */
  setSites(sites, size = 4) {
    this.sites = sites.map((site) => ({ ...site, outward: site.axis.map((value) => -value) }));
    for (const mark of [...this.marks.children]) this.drop(mark, this.marks);
    for (const site of this.sites) this.marks.add(siteMark(site, site.chosen ? 1.35 * size : size, (colour) => this.markPaint(colour)));
    this.overlay.setSites(this.sites);
    this.redraw();
  }

  showSites(shown) {
    this.marks.visible = shown;
    this.overlay.showSites(shown);
    this.redraw();
  }

  markPaint(colour) {
    if (!this.markPaints.has(colour)) this.markPaints.set(colour, new THREE.MeshBasicMaterial({ color: colour }));
    return this.markPaints.get(colour);
  }

  drop(part, parent = this.scene) {
    if (!part) return;
    parent.remove(part);
    part.traverse((piece) => {
      piece.geometry?.dispose();
      if (piece.material?.isMeshLambertMaterial) piece.material.dispose(); // of a surface, and of nothing else
    });
  }

  /** A mesh: {points, cells, regions, faces, owners, neighbours} and colours, one per region; null takes it away. */
  setMesh(mesh, colours = []) {
    this.drop(this.body);
    this.body = null;
    this.mesh = mesh;
    this.field = this.vectors = null;
    this.colours = colours.map((colour) => new THREE.Color(colour).toArray());
    this.visible = colours.map(() => true);
    if (!mesh) return this.redraw();
    this.body = new THREE.Mesh(new THREE.BufferGeometry(), this.paint);
    this.body.frustumCulled = false;
    this.scene.add(this.body);
    this.cutMesh(this.cut ?? null);
  }

  /** Cut by {normal, offset, whole}: what lies beyond goes, as whole cells or cut through; null shows all. */
  cutMesh(cut) {
    this.cut = cut;
    if (!this.mesh) return;
    this.corners = skinOf(this.mesh, { visible: this.visible, plane: cut, whole: cut?.whole ?? false });
    const { uniforms } = this.body.material;
    uniforms.cuts.value = Boolean(cut && !cut.whole);
    if (cut) uniforms.plane.value = [...cut.normal, cut.offset];
    const shape = this.body.geometry;
    shape.dispose();
    put(shape, "position", vectorsAt(this.corners, this.mesh.points), 3);
    put(shape, "tint", tintsOf(this.corners, this.mesh, this.colours), 3);
    put(shape, "inside", this.corners.inside, 1);
    shape.computeBoundingBox();
    shape.boundingSphere = null;
    this.setMoment(this.field, this.vectors);
  }

  showRegion(index, shown) {
    this.visible[index] = shown;
    this.cutMesh(this.cut);
  }

  /** Field values ({on: "cells" or "nodes", values}) and displacements of the nodes at a moment; null for none. */
  setMoment(field, vectors) {
    this.field = field;
    this.vectors = vectors;
    if (!this.body) return;
    const shape = this.body.geometry, { count } = this.corners;
    put(shape, "moved", vectorsAt(this.corners, vectors), 3);
    put(shape, "value", field ? valuesAt(this.corners, this.mesh, field) : new Float32Array(count), 1);
    this.body.material.uniforms.mapped.value = Boolean(field);
    this.redraw();
  }

  /** How a field is painted: {map, low, high, title}; null removes the colour bar. */
  setColours(scale) {
    drawColourBar(this.bar, scale && { ...scale, gradient: mapGradient(scale.map) }, shortNumber);
    if (!scale || !this.body) return;
    const { uniforms } = this.body.material;
    uniforms.range.value = [scale.low, scale.high > scale.low ? scale.high : scale.low + 1e-9];
    uniforms.map.value?.dispose();
    uniforms.map.value = new THREE.DataTexture(mapBytes(scale.map), 256, 1, THREE.RGBAFormat);
    Object.assign(uniforms.map.value, { magFilter: THREE.LinearFilter, minFilter: THREE.LinearFilter, needsUpdate: true });
    this.redraw();
  }

  setStyle({ edged, warp }) {
    if (!this.body) return;
    if (edged !== undefined) this.body.material.uniforms.edged.value = edged;
    if (warp !== undefined) this.body.material.uniforms.warp.value = warp;
    this.redraw();
  }

  /** A click that was no drag: tells onSite of a site, else onSurface or onMesh of the point hit; while `placing` that alone. */
  click(event) {
    if (this.view.moved > 4 || event.button !== 0) return;
    const site = this.placing ? null : this.siteAt(event);
    if (site && this.onSite) return this.onSite(site.name);
    const hit = this.surfaceAt(event, "skin");
    if (hit && this.onSurface) this.onSurface(hit);
    const at = !hit && this.onMesh ? this.meshAt(event) : null;
    if (at) this.onMesh(at);
  }

  /** The site whose mark is within a few pixels of a pointer, nearest first, or none. */
  siteAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const near = this.sites.map((site) => {
      const at = new THREE.Vector3(...site.at).project(this.view.camera);
      const x = ((at.x + 1) / 2) * box.width + box.left, y = ((1 - at.y) / 2) * box.height + box.top;
      const behind = site.outward.reduce((sum, value, k) => sum + value * this.view.axes().direction[k], 0) > 0.15;
      return { site, far: Math.hypot(event.clientX - x, event.clientY - y) + (behind ? 100 : 0) };
    });
    near.sort((one, other) => one.far - other.far);
    return near.length && near[0].far < 11 ? near[0].site : null;
  }

  /** Where a ray through a pointer first meets a surface: {point, normal}, or null. */
  surfaceAt(event, name) {
    const part = this.surfaces.get(name);
    if (!part) return null;
    const box = this.canvas.getBoundingClientRect();
    const at = new THREE.Vector2(
      (2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(at, this.view.camera);
    const [hit] = ray.intersectObject(part);
    return hit ? { point: hit.point.toArray(), normal: hit.face.normal.toArray() } : null;
  }

  /** Where a ray through a pointer first meets the mesh, uncut and undeformed: [x, y, z], or null. */
  meshAt(event) {
    if (!this.body) return null;
    const box = this.canvas.getBoundingClientRect();
    const at = new THREE.Vector2(
      (2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(at, this.view.camera);
    return ray.intersectObject(this.body)[0]?.point.toArray() ?? null;
  }

  /** Where on the page a point of space is drawn: [x, y] in pixels of the window. */
  pixelOf(point) {
    const box = this.canvas.getBoundingClientRect();
    const at = new THREE.Vector3(...point).project(this.view.camera);
    return [((at.x + 1) / 2) * box.width + box.left, ((1 - at.y) / 2) * box.height + box.top];
  }
}

/** Values of a shape in the buffer that it has, where they fit: moments that are played leave none behind. */
function put(shape, name, values, width) {
  const old = shape.getAttribute(name);
  if (old?.array.length !== values.length) return shape.setAttribute(name, new THREE.BufferAttribute(values, width));
  old.array.set(values);
  old.needsUpdate = true;
}

function meshMaterial() {
  return new THREE.ShaderMaterial({
    vertexShader: MESH_VERTEX, fragmentShader: MESH_FRAGMENT, glslVersion: "300 es", side: THREE.DoubleSide,
    uniforms: {
      warp: { value: 1 }, plane: { value: [0, 0, 1, 0] }, cuts: { value: false }, mapped: { value: false },
      edged: { value: true }, range: { value: [0, 1] }, map: { value: null },
    },
  });
}

function tintsOf(corners, mesh, colours) {
  const tints = new Float32Array(3 * corners.count);
  for (let i = 0; i < corners.count; i++) tints.set(colours[mesh.regions[corners.cell[i]]], 3 * i);
  return tints;
}

/** A ball on the skin, open where the site is held out, and a rod along the indenter's axis. */
function siteMark(site, size, paintOf) {
  const mark = new THREE.Group();
  const paint = paintOf(site.colour);
  mark.add(new THREE.Mesh(new THREE.SphereGeometry(size, 20, 14), paint));
  if (!site.filled) {
    const heart = new THREE.Mesh(new THREE.SphereGeometry(0.62 * size, 16, 12), paintOf("#ffffff"));
    heart.position.set(...site.axis.map((value) => -0.5 * size * value));
    mark.add(heart);
  }
  const rod = new THREE.Mesh(new THREE.CylinderGeometry(0.22 * size, 0.22 * size, 4 * size, 10), paint);
  rod.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), new THREE.Vector3(...site.axis));
  rod.position.set(...site.axis.map((value) => -2 * size * value));
  mark.add(rod);
  mark.position.set(...site.at);
  return mark;
}
