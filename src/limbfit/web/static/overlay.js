// What is written over the picture: names of sites, sides of the patient, a scale bar, a colour bar.

/** An element with attributes and children; texts are never read as HTML. */
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key in made && key !== "list" && key !== "form") made[key] = value;
    else made.setAttribute(key, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export class Overlay {
  constructor(host) {
    this.host = element("div", { className: "lf-overlay", ariaHidden: "true" });
    this.labels = new Map();
    this.sides = ["L", "P", "S"].map((text) => element("span", { className: "lf-side", textContent: text }));
    this.lines = this.sides.map(() => element("i", { className: "lf-side-line" }));
    this.scale = element("span", { className: "lf-scale" });
    this.host.append(...this.lines, ...this.sides, this.scale);
    host.append(this.host);
  }

  /** sites: [{name, at, outward, shown}], where at is in mm. */
  setSites(sites) {
    for (const label of this.labels.values()) label.remove();
    this.labels = new Map(sites.map((site) => [site, element("span", { className: "lf-label", textContent: site.name })]));
    this.host.append(...this.labels.values());
  }

  showSites(shown) {
    for (const label of this.labels.values()) label.hidden = !shown;
  }

  draw(view, width, height) {
    const { direction, right, above } = view.axes();
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const perPixel = (2 * view.half) / height;
    for (const [site, label] of this.labels) {
      const from = site.at.map((value, k) => value - view.target[k]);
      const x = width / 2 + dot(from, right) / perPixel, y = height / 2 - dot(from, above) / perPixel;
      label.style.transform = `translate(${x + 9}px, ${y - 9}px)`;
      label.classList.toggle("lf-behind", dot(site.outward, direction) > 0.15);
      label.classList.toggle("lf-chosen", Boolean(site.chosen));
    }
    this.drawSides(right, above, height);
    const length = niceLength(120 * perPixel);
    this.scale.style.width = `${length / perPixel}px`;
    this.scale.textContent = `${length} mm`;
  }

  /** The axes of patient space (left, posterior, superior) as they lie now. */
  drawSides(right, above, height) {
    for (let k = 0; k < 3; k++) {
      const x = 46 + 30 * right[k], y = height - 46 - 30 * above[k];
      this.sides[k].style.transform = `translate(${x - 6}px, ${y - 9}px)`;
      const length = 22 * Math.hypot(right[k], above[k]);
      this.sides[k].hidden = this.lines[k].hidden = length < 11; // it points at who looks
      this.lines[k].style.width = `${length}px`;
      this.lines[k].style.transform = `translate(46px, ${height - 46}px) rotate(${Math.atan2(-above[k], right[k])}rad)`;
    }
  }
}

function niceLength(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return [5, 2, 1].map((step) => step * power).find((length) => length <= most) ?? power;
}

/** A colour bar with its quantity and ends: {title, low, high, gradient, beyond}; nothing for null. beyond: whether values lie [below, above]. */
export function drawColourBar(host, bar, shortNumber) {
  host.replaceChildren();
  host.hidden = !bar;
  if (!bar) return;
  const strip = element("span", { className: "lf-bar-strip" });
  strip.style.background = bar.gradient;
  const values = [0, 0.25, 0.5, 0.75, 1].map((share) => bar.low + share * (bar.high - bar.low));
  const [below, above] = bar.beyond ?? [false, false];
  const signs = [below ? "≤ " : "", "", "", "", above ? "≥ " : ""];
  const ticks = values.map((value, i) =>
    element("span", { textContent: signs[i] + shortNumber(Math.abs(value) < 1e-4 * (bar.high - bar.low) ? 0 : value) }));
  host.append(element("span", { className: "lf-bar-title", textContent: bar.title }), strip,
    element("span", { className: "lf-bar-ticks" }, ...ticks));
}
