// Diagram of the feeder: built once per feeder and width, coloured at every tick.

import { busbarWords, byId, el, isKnown, nominals, signed, status, svg, volt } from "./dom.js";
import { hasMap, oneLine } from "./layout.js";
import { Scale } from "./scale.js";

const LINE = 12; // Height of a line of a note, px.

// Shapes around (0, 0): the status of a customer must be readable without colour.
const SHAPE = {
  ok: "M-7 0a7 7 0 1 0 14 0a7 7 0 1 0-14 0z",
  none: "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0z",
  silent: "M-8 0a8 8 0 1 0 16 0a8 8 0 1 0-16 0z",
  unjudged: "M-7 0a7 7 0 1 0 14 0a7 7 0 1 0-14 0zM-3 0H3",
  doubtful: "M-8-8H8V8H-8z",
  suspect: "M0-12L12 0L0 12L-12 0z",
  high: "M0-10L10 7H-10z",
  low: "M0 10L10-7H-10z",
};
const SIGN = { suspect: "!", doubtful: "?", silent: "?" };
// Without the colour of the voltage, which is uncertain here.
const PLAIN = new Set(["silent", "unjudged", "doubtful"]);
const LEGEND = [
  ["ok", "consistent"],
  ["suspect", "suspect: contradicts the feeder"],
  ["doubtful", "doubtful: beyond its threshold, but not named"],
  ["unjudged", "not monitored"],
  ["silent", "silent"],
  ["high", "above limit"],
  ["low", "below limit"],
  ["none", "no meter"],
];

function sharedPrefix(names) {
  if (names.length < 2) return 0;
  let k = 0;
  while (k < names[0].length && names.every((name) => name[k] === names[0][k])) k += 1;
  while (k > 0 && /[A-Za-z0-9]/.test(names[0][k - 1])) k -= 1;
  return k;
}

const named = ({ customer, phase }) => `${customer}${phase ? `, phase ${phase}` : ""}`;

export class Diagram {
  constructor({ onSelect }) {
    this.box = byId("diagram");
    this.tip = byId("tip");
    this.onSelect = onSelect;
    this.scale = new Scale();
    this.view = "line";
    this.selected = null;
    this.hovered = null;
    this.drawn = 0;
    new ResizeObserver(() => {
      if (this.feeder && Math.abs(this.box.clientWidth - this.drawn) > 8) this.build();
    }).observe(this.box);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.scale.theme();
      if (this.feeder) this.rescale();
      this.paint();
    });
    for (const button of byId("view").querySelectorAll("button")) {
      button.addEventListener("click", () => this.look(button.dataset.view));
    }
    byId("legend").replaceChildren(...LEGEND.map(([key, text]) => el("li", {},
      svg("svg", { viewBox: "-14 -14 28 28", "aria-hidden": true },
        svg("g", { class: "customer", "data-status": key }, svg("path", { class: "shape", d: SHAPE[key] }),
          svg("text", { class: "sign", y: 5, text: SIGN[key] ?? "" }))),
      text)));
  }

  show(feeder) {
    this.feeder = feeder;
    this.limits = { low: feeder.v_min_volt, high: feeder.v_max_volt };
    this.nominal = nominals(feeder);
    this.level = new Set(this.nominal.values()).size > 1 ? null : feeder.v_nominal_volt;
    this.report = null;
    this.placed = oneLine(feeder.layout);
    this.mapped = hasMap(feeder.layout);
    byId("view").hidden = !this.mapped;
    this.view = "line";
    this.cut = sharedPrefix(feeder.layout.customers.map((c) => c.customer));
    this.scale.fit([], this.level);
    this.rescale();
    this.look("line");
  }

  clear() {
    this.feeder = this.report = null;
    this.hover(null);
    this.box.replaceChildren();
    byId("scale").replaceChildren();
    byId("view").hidden = true;
  }

  look(view) {
    this.view = view;
    for (const button of byId("view").querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.dataset.view === view));
    }
    this.build();
  }

  build() {
    this.drawn = this.box.clientWidth;
    this.lines = [];
    this.customers = new Map();
    const { root, spots, wires, busbar } = this.view === "map" ? this.mapParts() : this.lineParts();
    const [casing, layer] = [svg("g", {}), svg("g", {})];
    for (const wire of wires) {
      if (wire.kind === "tie") {
        casing.append(svg("path", { class: "tie", d: wire.d }));
        continue;
      }
      const path = svg("path", { class: `wire ${wire.kind ?? ""}`, d: wire.d });
      this.lines.push({ path, bus: wire.bus });
      casing.append(svg("path", { class: `casing ${wire.kind ?? ""}`, d: wire.d }));
      layer.append(path);
    }
    const names = this.feeder.layout.customers;
    spots.sort((a, b) => a.order - b.order).forEach((spot, k) => {
      if (spot.customer === null) return;
      const customer = names[spot.customer];
      const shape = svg("path", { class: "shape" });
      const sign = svg("text", { class: "sign", y: 5 });
      const note = svg("text", { class: "note", ...spot.note });
      const group = svg("g", {
        class: "customer", transform: `translate(${spot.x} ${spot.y}) scale(${spot.size})`, role: "button",
        "aria-label": `${named(customer)}: no data`,
        tabindex: k === 0 ? 0 : -1,
        on: {
          click: () => this.onSelect(customer.customer),
          keydown: (event) => this.key(event, customer.customer),
          pointerenter: (event) => this.hover(event.pointerType === "mouse" ? customer.customer : null),
          pointerleave: () => this.hover(null),
          focus: () => this.hover(group.matches(":focus-visible") ? customer.customer : null),
          blur: () => this.hover(null),
        },
      }, svg("circle", { class: "hit", r: 13 }), shape, sign, note);
      this.customers.set(customer.customer, {
        customer, group, shape, sign, note, labels: spot.labels, place: spot.note, order: spot.order,
      });
      layer.append(group);
    });
    const place = { transform: `translate(${busbar.x} ${busbar.y})` };
    this.liar = svg("g", { class: "busbar-liar", role: "img", hidden: true, ...place },
      svg("path", { class: "shape", d: SHAPE.suspect }), svg("text", { class: "sign", y: 5, text: SIGN.suspect }),
      svg("text", { class: "note", x: 17, y: 4 }));
    root.append(casing, layer, this.liar);
    this.box.replaceChildren(root);
    this.hover(null);
    this.paint();
  }

  lineParts() {
    const { rows, columns } = this.placed;
    const width = Math.max(280, this.box.clientWidth);
    const upright = width < 620 && columns > 8;
    const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
    const pad = 26;
    const along = upright ? 32 : clamp((width - 2 * pad - 10) / columns, 25, 104);
    const across = upright ? clamp((width - pad - 12) / rows, 62, 120) : clamp(480 / rows, 68, 120);
    const size = clamp(Math.min(along / 52, across / 76), 1, 1.35);
    const labels = !upright && along >= 44;
    const at = (x, row) => (upright
      ? [pad + row * across, pad + 12 + x * along]
      : [pad + x * along, pad + 6 + row * across]);
    const hang = upright ? [28, 0] : [0, 29 * size];
    const join = (x0, row0, x, row) => {
      const [ax, ay] = at(x0, row0);
      const [bx, by] = at(x, row);
      return upright ? `M${ax} ${ay}H${bx}V${by}` : `M${ax} ${ay}V${by}H${bx}`;
    };
    const wires = [];
    for (const line of this.placed.lines) wires.push({ d: join(line.x0, line.row0, line.x, line.row), bus: line.bus });
    for (const bus of this.placed.buses) {
      if (bus.to > bus.x) wires.push({ d: join(bus.x, bus.row, bus.to, bus.row), bus: bus.bus });
      const [x, y] = at(bus.x, bus.row);
      if (bus.bare) wires.push({ d: upright ? `M${x - 5} ${y}h10` : `M${x} ${y - 5}v10`, bus: bus.bus, kind: "bus" });
    }
    const spots = this.placed.customers.map((c) => {
      const [x, y] = at(c.x, c.row);
      wires.push({ d: `M${x} ${y}l${hang[0]} ${hang[1]}`, bus: c.bus, kind: "drop" });
      const note = upright ? { x: 17, y: 4, "text-anchor": "start" } : { x: 0, y: 26, "text-anchor": "middle" };
      return { customer: c.customer, x: x + hang[0], y: y + hang[1], size, note, labels, order: c.row * 1e4 + c.x };
    });
    const places = new Map();
    for (const b of this.placed.buses) places.set(b.bus, [b.x, b.row, 0]);
    for (const c of this.placed.customers) if (c.bus !== c.from) places.set(c.bus, [c.x, c.row, 1]);
    for (const [one, other] of this.feeder.layout.ties ?? []) {
      // A tie meets the busbar at the row of its other end.
      const ends = [one, other].map((bus, k) => places.get(bus) ?? [0, places.get(k ? one : other)?.[1] ?? 0, 0]);
      const [[ax, ay], [bx, by]] = ends.map(([x, row, low]) => {
        const [px, py] = at(x, row);
        return [px + low * hang[0], py + low * hang[1]];
      });
      // Bent, so that the row of the loop does not hide it.
      const bend = Math.min(36, 12 + 0.2 * Math.hypot(bx - ax, by - ay));
      const [mx, my] = [(ax + bx) / 2 - (upright ? bend : 0), (ay + by) / 2 - (upright ? 0 : bend)];
      wires.push({ d: `M${ax} ${ay}Q${mx} ${my} ${bx} ${by}`, kind: "tie" });
    }
    const [x0, y0] = at(0, 0);
    const [x1, y1] = at(0, rows - 1);
    wires.push({
      d: upright ? `M${x0 - 12} ${y0}H${x1 + 12}` : `M${x0} ${y0 - 12}V${y1 + 12}`, bus: 0, kind: "busbar",
    });
    const right = at(columns - 1, rows - 1);
    const extent = upright
      ? [Math.max(width - 4, right[0] + 78), right[1] + 24]
      : [Math.max(right[0] + pad, 200), right[1] + (55 + 3 * LINE) * size + 8]; // Drop, note, two lines, a lower one.
    const root = svg("svg", {
      width: extent[0], height: extent[1], viewBox: `0 0 ${extent[0]} ${extent[1]}`, role: "group",
      "aria-label": `One-line diagram, ${this.feeder.layout.customers.length} customers`,
    }, svg("text", { class: "busbar-name", x: 8, y: 12, text: this.feeder.layout.buses[0] }));
    this.busbarName = root.firstChild;
    // Beyond the end of the busbar, where the drawing is empty.
    return { root, spots, wires, busbar: upright ? { x: x1 + 27, y: y0 } : { x: x0, y: y1 + 27 } };
  }

  mapParts() {
    const { xy, parent, buses, customers } = this.feeder.layout;
    const width = Math.max(280, this.box.clientWidth);
    const [xs, ys] = [xy.map((p) => p[0]), xy.map((p) => p[1])];
    const span = [Math.max(...xs) - Math.min(...xs) || 1, Math.max(...ys) - Math.min(...ys) || 1];
    const height = Math.min(680, Math.max(320, (width * span[1]) / span[0]));
    const pad = 30;
    const factor = Math.min((width - 2 * pad) / span[0], (height - 2 * pad) / span[1]);
    const at = (k) => [
      (width - span[0] * factor) / 2 + (xs[k] - Math.min(...xs)) * factor,
      height - (height - span[1] * factor) / 2 - (ys[k] - Math.min(...ys)) * factor,
    ];
    const wires = buses.slice(1).map((_, i) => {
      const [ax, ay] = at(parent[i + 1] ?? 0);
      const [bx, by] = at(i + 1);
      return { d: `M${ax} ${ay}L${bx} ${by}`, bus: i + 1 };
    });
    for (const [one, other] of this.feeder.layout.ties ?? []) {
      wires.push({ d: `M${at(one).join(" ")}L${at(other).join(" ")}`, kind: "tie" });
    }
    const [bx, by] = at(0);
    wires.push({ d: `M${bx - 9} ${by}h18M${bx} ${by - 9}v18`, bus: 0, kind: "busbar" });
    const index = new Map(buses.map((id, k) => [id, k]));
    const here = new Map();
    const spots = customers.map((c, k) => {
      const bus = index.get(c.bus) ?? 0;
      const count = here.get(bus) ?? 0;
      here.set(bus, count + 1);
      const [x, y] = at(bus);
      const note = { x: 0, y: 24, "text-anchor": "middle" };
      return { customer: k, x: x + 15 * count, y, size: 1, note, labels: false, order: k };
    });
    const root = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Map" });
    this.busbarName = null;
    return { root, spots, wires, busbar: { x: bx, y: by - 17 } };
  }

  update(report) {
    this.report = report;
    this.meters = new Map(report.meters.map((meter) => [meter.meter, meter]));
    this.volts = new Map(report.buses.map((bus) => [bus.bus, bus.v_volt]));
    this.modelled = new Set(report.buses.filter((bus) => bus.model_only).map((bus) => bus.bus));
    this.customersModelled = new Set((report.customers ?? []).filter((c) => c.model_only).map((c) => c.customer));
    this.phases = new Map(report.buses.map((bus) => [bus.bus, bus.v_phases]));
    const parts = [...this.volts].filter(([bus]) => !this.modelled.has(bus)).map(([bus, v]) => this.part(bus, v)).filter(isKnown);
    parts.push(...report.meters.filter((m) => !m.model_only).map((m) => m.v2_pu_estimated).filter(isKnown).map(Math.sqrt));
    if (this.scale.fit(parts, this.level)) this.rescale();
    this.paint();
    this.hover(this.hovered);
  }

  rescale() {
    const { v_nominal_volt: nominal } = this.feeder;
    this.scale.draw({ low: this.limits.low / nominal, high: this.limits.high / nominal });
  }

  // Voltage over the nominal voltage of its bus.
  part(bus, v) {
    return isKnown(v) ? v / this.nominal.get(bus) : NaN;
  }

  // True if the voltage of a customer is model only.
  alone(customer) {
    const meter = this.meters.get(customer.meter);
    return meter ? meter.model_only : this.customersModelled.has(customer.customer) || this.modelled.has(customer.bus);
  }

  voltAt(customer) {
    const meter = this.meters.get(customer.meter);
    if (isKnown(meter?.v_volt_estimated)) return meter.v_volt_estimated;
    const phases = this.phases.get(customer.bus);
    return phases ? phases["abc".indexOf(customer.phase)] : this.volts.get(customer.bus);
  }

  paint() {
    if (!this.report || !this.customers) return;
    const { buses } = this.feeder.layout;
    for (const { path, bus } of this.lines) {
      const color = this.modelled.has(buses[bus]) ? null : this.scale.color(this.part(buses[bus], this.volts.get(buses[bus])));
      path.classList.toggle("unknown", color === null);
      path.style.stroke = color ?? "";
    }
    let before = null;
    for (const [id, part] of this.customers) {
      const meter = this.meters.get(part.customer.meter);
      const now = status(meter, this.limits, this.report);
      const v = this.voltAt(part.customer);
      part.group.setAttribute("data-status", now.key);
      part.shape.setAttribute("d", SHAPE[now.key]);
      const alone = this.alone(part.customer);
      part.shape.style.fill = alone || PLAIN.has(now.key) ? "" : (this.scale.color(this.part(part.customer.bus, v)) ?? "");
      part.sign.textContent = SIGN[now.key] ?? "";
      const loud = now.key === "suspect";
      // Notes of neighbouring suspects must not overlap.
      const low = loud && !part.labels && before?.loud && !before.low && before.near(part);
      if (part.place.y > 10) part.note.setAttribute("y", part.place.y + (low ? 2 * LINE : 0));
      before = { loud, low, near: (other) => other.order - part.order === 1 };
      part.note.classList.toggle("loud", loud);
      const whole = id.slice(this.cut);
      const name = whole.length > 8 ? `${whole.slice(0, 7)}…` : whole;
      // A suspect keeps its name above its deviation, also where other names have no room.
      const lines = loud ? [name, signed(meter.attack_volt_estimated)] : [part.labels ? name : ""];
      const x = part.note.getAttribute("x");
      part.note.replaceChildren(...lines.map((text, k) => svg("tspan", { x, dy: k ? LINE : null, text })));
      part.group.setAttribute("aria-label", `${named(part.customer)}: ${now.text}, ${alone ? "model only" : "reconstructed"} ${volt(v)}`);
      part.group.classList.toggle("selected", id === this.selected);
    }
    const busbar = this.report.busbar ?? {};
    if (this.busbarName) {
      const mark = busbar.suspect ? "◆ " : "";
      this.busbarName.textContent = `${mark}Busbar (${buses[0]}): ${volt(this.volts.get(buses[0]))}${this.modelled.has(buses[0]) ? " (model only)" : ""}`;
      this.busbarName.classList.toggle("suspect", Boolean(busbar.suspect));
    }
    this.liar.toggleAttribute("hidden", !busbar.suspect);
    if (busbar.suspect) {
      this.liar.setAttribute("aria-label", busbarWords(busbar));
      this.liar.querySelector(".note").textContent = signed(busbar.attack_volt_estimated);
    }
  }

  select(id) {
    this.selected = id;
    this.tip.hidden = true;
    this.paint();
  }

  key(event, id) {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      this.onSelect(id);
    } else if (step) {
      event.preventDefault();
      const ids = [...this.customers.keys()];
      const next = this.customers.get(ids[(ids.indexOf(id) + step + ids.length) % ids.length]);
      this.customers.get(id).group.setAttribute("tabindex", -1);
      next.group.setAttribute("tabindex", 0);
      next.group.focus();
    }
  }

  hover(id) {
    this.hovered = id;
    const part = id === null || id === this.selected ? null : this.customers.get(id);
    this.tip.hidden = !part || !this.report;
    if (this.tip.hidden) return;
    const meter = this.meters.get(part.customer.meter);
    const now = status(meter, this.limits, this.report);
    this.tip.replaceChildren(
      el("b", { text: id }),
      ...(part.customer.phase ? [el("span", { text: `phase ${part.customer.phase}` })] : []),
      el("span", { class: "state", "data-status": now.key, text: now.text }),
      el("span", { text: `reported ${volt(meter?.v_volt_reported)}` }),
      el("span", { text: `${this.alone(part.customer) ? "model only" : "reconstructed"} ${volt(this.voltAt(part.customer))}` }),
    );
    const card = this.tip.parentElement.getBoundingClientRect();
    const spot = part.group.getBoundingClientRect();
    const left = Math.min(Math.max(spot.left - card.left + spot.width / 2, 90), card.width - 90);
    this.tip.style.left = `${left}px`;
    this.tip.style.top = `${spot.top - card.top - 8}px`;
  }
}
