// Colour of a voltage: blue is low, orange is high, the middle is the nominal voltage. The range fits the data
// in few steps, so that the colours rarely change their meaning; its ends are labelled. Voltages are relative
// to the nominal one, which is null if there are several.

import { bare, byId, el, svg } from "./dom.js";

const STEPS = [0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.25];
const STOPS = ["--v-low2", "--v-low1", "--v-mid", "--v-high1", "--v-high2"];

const parse = (text) => {
  const hex = text.trim().replace("#", "");
  return [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16));
};

export class Scale {
  constructor() {
    this.nominal = 230;
    this.range = STEPS[0];
    this.theme();
  }

  theme() {
    const style = getComputedStyle(document.documentElement);
    this.stops = STOPS.map((name) => parse(style.getPropertyValue(name)));
  }

  // Returns true if the range changed.
  fit(parts, nominal) {
    const largest = Math.max(0, ...parts.map((part) => Math.abs(part - 1)));
    const needed = STEPS.find((step) => step >= largest) ?? STEPS.at(-1);
    const keep = this.nominal === nominal && this.range >= needed && largest > 0.55 * needed && this.range <= 2 * needed;
    const range = keep ? this.range : needed;
    const changed = range !== this.range || nominal !== this.nominal;
    this.range = range;
    this.nominal = nominal;
    return changed;
  }

  color(part) {
    if (!Number.isFinite(part)) return null;
    const at = Math.min(1, Math.max(-1, (part - 1) / this.range)) * 2 + 2;
    const k = Math.min(3, Math.floor(at));
    const mix = this.stops[k].map((a, i) => Math.round(a + (this.stops[k + 1][i] - a) * (at - k)));
    return `rgb(${mix.join(",")})`;
  }

  draw(limits) {
    const { nominal, range } = this;
    const stops = this.stops.map((c, k) => svg("stop", { offset: `${25 * k}%`, "stop-color": `rgb(${c.join(",")})` }));
    const bar = svg("svg", { class: "bar", "aria-hidden": true, height: 12 },
      svg("defs", {}, svg("linearGradient", { id: "ramp" }, ...stops)),
      svg("rect", { width: "100%", height: 12, rx: 3, fill: "url(#ramp)" }));
    const marks = [-1, -0.5, 0, 0.5, 1].map((k) => {
      const pu = 1 + k * range;
      const part = `${pu.toFixed(range < 0.02 || range === 0.03 || range === 0.075 ? 4 : 3)} pu`;
      const tick = nominal === null
        ? el("span", { class: "tick" }, el("b", { text: part }))
        : el("span", { class: "tick" }, el("b", { text: `${bare(pu * nominal)} V` }), el("span", { text: part }));
      tick.style.left = `${50 + 50 * k}%`;
      return tick;
    });
    const edges = [["low", limits.low], ["high", limits.high]]
      .map(([name, part]) => [name, (part - 1) / range])
      .filter(([, place]) => Math.abs(place) <= 1)
      .map(([name, place]) => {
        const edge = el("span", { class: `edge ${name}`, title: `${name} limit` });
        edge.style.left = `${50 + 50 * place}%`;
        return edge;
      });
    byId("scale").replaceChildren(bar, ...edges, el("div", { class: "ticks" }, ...marks));
  }
}
