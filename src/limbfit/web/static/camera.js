// A parallel projection that keeps a direction up: turned, moved and enlarged by mouse, touch and keys.
const STEP = Math.PI / 18; // 10 degrees
const SIDES = { 1: 0, 2: Math.PI / 2, 3: Math.PI, 4: -Math.PI / 2 }; // anterior, left, posterior, right

export const CAMERA_KEYS =
  "Arrow keys turn, with Shift they move; plus and minus enlarge and shrink; 1 to 4 show the anterior, left, posterior " +
  "and right side; 0 starts again.";

export class OrbitCamera {
  /** frame: rows left, back and up of the patient; changed is called after every change. */
  constructor(element, changed) {
    this.camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0.1, 4000);
    this.element = element;
    this.changed = changed;
    this.frame = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    this.home = { target: [0, 0, 0], half: 100, azimuth: 0, elevation: 0.1 };
    this.aspect = 1;
    this.pointers = new Map();
    this.moved = 0;
    this.reset();
    this.listen();
  }

  /** What to look at: a box {low, high} in mm, and the sides of the patient. */
  look(box, frame) {
    this.frame = frame ?? this.frame;
    const size = box.high.map((value, k) => value - box.low[k]);
    this.home = { ...this.home, target: box.low.map((value, k) => value + size[k] / 2), half: 0.54 * Math.hypot(...size) };
    this.reset();
  }

  reset() {
    Object.assign(this, { ...this.home, target: [...this.home.target] });
    this.update();
  }

  /** Turn to look along a direction of the patient's space. */
  lookAlong(direction) {
    const [left, back, up] = this.frame.map((axis) => axis.reduce((sum, value, k) => sum + value * direction[k], 0));
    this.azimuth = Math.atan2(-left, back);
    this.elevation = Math.asin(Math.max(-1, Math.min(1, -up)));
    this.update();
  }

  /** Where the camera looks, and what is right and up for it. */
  axes() {
    const [left, back, up] = this.frame;
    const mix = (a, b, c) => [0, 1, 2].map((k) => a * left[k] + b * back[k] + c * up[k]);
    const { azimuth: az, elevation: el } = this;
    const direction = mix(-Math.sin(az) * Math.cos(el), Math.cos(az) * Math.cos(el), -Math.sin(el));
    const above = mix(-Math.sin(az) * Math.sin(el), Math.cos(az) * Math.sin(el), Math.cos(el));
    return { direction, right: mix(Math.cos(az), Math.sin(az), 0), above };
  }

  update() {
    const { direction, above } = this.axes();
    const { camera, half, aspect } = this;
    camera.position.set(...this.target.map((value, k) => value - 2000 * direction[k]));
    camera.up.set(...above);
    camera.lookAt(...this.target);
    Object.assign(camera, { left: -half * aspect, right: half * aspect, top: half, bottom: -half });
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    this.changed();
  }

  turn(dx, dy) {
    this.azimuth += dx;
    this.elevation = Math.max(-1.55, Math.min(1.55, this.elevation + dy));
    this.update();
  }

  move(dx, dy) {
    const { right, above } = this.axes();
    this.target = this.target.map((value, k) => value - dx * right[k] + dy * above[k]);
    this.update();
  }

  zoom(factor) {
    this.half = Math.max(0.02 * this.home.half, Math.min(5 * this.home.half, this.half * factor));
    this.update();
  }

  listen() {
    const on = (name, act, options) => this.element.addEventListener(name, act, options);
    on("pointerdown", (event) => this.press(event));
    on("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) on(name, (event) => this.pointers.delete(event.pointerId));
    on("wheel", (event) => this.wheel(event), { passive: false });
    on("contextmenu", (event) => event.preventDefault());
    on("keydown", (event) => this.key(event));
  }

  press(event) {
    this.element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.moved = 0;
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
    this.moved += Math.abs(dx) + Math.abs(dy);
    const before = this.spread();
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const perPixel = (2 * this.half) / this.element.clientHeight;
    if (this.pointers.size === 2) {
      this.move((dx * perPixel) / 2, (dy * perPixel) / 2);
      this.zoom(before / Math.max(this.spread(), 1));
    } else if (event.shiftKey || event.buttons > 1) this.move(dx * perPixel, dy * perPixel);
    else this.turn(-dx * 0.008, dy * 0.008);
  }

  spread() {
    const [a, b] = [...this.pointers.values()];
    return a && b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 1;
  }

  /** The page scrolls on until the picture was clicked, so that nobody is caught in it. */
  wheel(event) {
    if (document.activeElement !== this.element) return;
    event.preventDefault();
    this.zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.003));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const shift = event.shiftKey, far = this.half / 10;
    const acts = {
      ArrowLeft: () => (shift ? this.move(-far, 0) : this.turn(STEP, 0)),
      ArrowRight: () => (shift ? this.move(far, 0) : this.turn(-STEP, 0)),
      ArrowUp: () => (shift ? this.move(0, -far) : this.turn(0, STEP)),
      ArrowDown: () => (shift ? this.move(0, far) : this.turn(0, -STEP)),
      "+": () => this.zoom(0.85), "=": () => this.zoom(0.85), "-": () => this.zoom(1 / 0.85), 0: () => this.reset(),
    };
    const act = acts[event.key] ?? (event.key in SIDES ? () => this.side(SIDES[event.key]) : null);
    if (!act) return;
    event.preventDefault();
    act();
  }

  side(azimuth) {
    Object.assign(this, { azimuth, elevation: 0 });
    this.update();
  }
}
