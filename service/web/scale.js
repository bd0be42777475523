// Colour of a voltage between the limits of its feeder: blue towards the low limit, orange towards the high one,
// grey at the nominal voltage; beyond a limit the darkest tone (on a dark page the brightest). The colours keep
// their meaning, whatever the readings are. Voltages are relative to the nominal one of their bus.

import { bare, byId, el, isKnown, svg } from "./dom.js";

const STOPS = ["--v-low2", "--v-low1", "--v-mid", "--v-high1", "--v-high2"];
const BEYOND = ["--v-below", "--v-above"];
const AIR = 0.08; // Part of the bar beyond each limit.

const parse = (text) => {
  const hex = text.trim().replace("#", "");
  return [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16));
};
const css = (rgb) => `rgb(${rgb.join(",")})`;

export class Scale {
  constructor() {
    this.limits = { low: 0.9, high: 1.1 };
    this.nominal = null;
    this.range = [NaN, NaN];
    this.theme();
  }

  theme() {
    const style = getComputedStyle(document.documentElement);
    [this.stops, this.beyond] = [STOPS, BEYOND].map((names) => names.map((name) => parse(style.getPropertyValue(name))));
  }

  // Limits relative to the nominal voltage; `nominal`, V, is null if there are several.
  open(limits, nominal) {
    Object.assign(this, { limits, nominal, range: [NaN, NaN] });
    const middle = (limits.low + limits.high) / 2;
    this.middle = limits.low < 1 && 1 < limits.high ? 1 : middle;
    this.draw();
  }

  // Place between the limits: -1 at the low one, 0 in the middle, 1 at the high one.
  place(part) {
    const { limits: { low, high }, middle } = this;
    return part < middle ? (part - middle) / (middle - low) : (part - middle) / (high - middle);
  }

  color(part) {
    if (!Number.isFinite(part)) return null;
    const place = this.place(part);
    if (Math.abs(place) > 1) return css(this.beyond[place < 0 ? 0 : 1]);
    const at = 2 * place + 2;
    const k = Math.min(3, Math.floor(at));
    return css(this.stops[k].map((a, i) => Math.round(a + (this.stops[k + 1][i] - a) * (at - k))));
  }

  // Mark the lowest and the highest present voltage.
  mark(parts) {
    this.range = parts.length ? [Math.min(...parts), Math.max(...parts)] : [NaN, NaN];
    const band = byId("scale").querySelector(".present");
    band.hidden = !this.range.every(Number.isFinite);
    if (band.hidden) return;
    const [left, right] = this.range.map((part) => this.left(part));
    band.style.left = `${left}%`;
    band.style.width = `${Math.max(right - left, 0.4)}%`;
    band.title = `present: ${this.text(this.range[0])} to ${this.text(this.range[1])}`;
  }

  // Place on the bar, %.
  left(part) {
    const place = Math.min(1 + 2 * AIR, Math.max(-1 - 2 * AIR, this.place(part)));
    return 50 + (50 * place) / (1 + 2 * AIR);
  }

  text(part) {
    return this.nominal === null ? `${part.toFixed(3)} pu` : `${bare(part * this.nominal)} V`;
  }

  draw() {
    const { limits: { low, high }, middle, nominal } = this;
    const inside = (k) => this.left(k < 2 ? low + (k / 2) * (middle - low) : middle + ((k - 2) / 2) * (high - middle));
    const stop = (offset, rgb) => svg("stop", { offset: `${offset}%`, "stop-color": css(rgb) });
    const stops = this.stops.map((rgb, k) => stop(inside(k), rgb));
    const [below, above] = this.beyond;
    const bar = svg("svg", { class: "bar", "aria-hidden": true, height: 12 },
      svg("defs", {}, svg("linearGradient", { id: "ramp" }, stop(0, below), stop(inside(0), below), ...stops, stop(inside(4), above), stop(100, above))),
      svg("rect", { width: "100%", height: 12, rx: 3, fill: "url(#ramp)" }));
    const tick = (part, name) => {
      const found = el("span", { class: "tick" }, el("b", { text: this.text(part) }),
        el("span", { text: name }), nominal === null ? null : el("span", { class: "pu", text: `, ${part.toFixed(3)} pu` }));
      found.style.left = `${this.left(part)}%`;
      return found;
    };
    const edges = [["low", low], ["high", high]].map(([name, part]) => {
      const edge = el("span", { class: `edge ${name}`, title: `${name} limit` });
      edge.style.left = `${this.left(part)}%`;
      return edge;
    });
    byId("scale").replaceChildren(bar, el("span", { class: "present", hidden: true }), ...edges,
      el("div", { class: "ticks" }, tick(low, "low limit"), tick(middle, middle === 1 ? "nominal" : "middle"), tick(high, "high limit")));
    if (this.range.every(isKnown)) this.mark(this.range);
  }
}
