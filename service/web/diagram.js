// Diagram of the feeder: built once per feeder, window and set of collapsed branches, coloured at every tick.

import { busbarWords, byId, deviceName, el, isKnown, nominals, signed, status, svg, volt } from "./dom.js";
import { placeLabels } from "./labels.js";
import { hasMap } from "./layout.js";
import { mapPlaces, onePlaces } from "./places.js";
import { Scale } from "./scale.js";
import { Viewport } from "./viewport.js";

const HOLD_S = 60; // Time for which a branch stays open after its last suspect, s.
const ROOM = [44, 72]; // Least distance of customers with labels, and of their rows, px.
const OPENED = 30; // Customers of a branch that open at once; those behind stay collapsed.
const MARGIN = 34; // Least distance of a visible suspect from the edge of the window, px.
const MANY = 300; // Number of customers beyond which colours change at once.

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
const STUB = "M-21-11H21a4 4 0 0 1 4 4V7a4 4 0 0 1-4 4H-21a4 4 0 0 1-4-4V-7a4 4 0 0 1 4-4z";
const STATION = "M-9-9H9V9H-9zM-9 0H9M0-9V9";
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
const WORDS = { ok: "consistent", high: "above limit", low: "below limit", doubtful: "doubtful", unjudged: "not monitored", silent: "silent", none: "without a meter" };

// Length of the part that all names begin with, up to a word.
function sharedPrefix(names) {
  if (names.length < 2) return 0;
  let k = 0;
  while (k < names[0].length && names.every((name) => name[k] === names[0][k])) k += 1;
  while (k > 0 && /[A-Za-z0-9]/.test(names[0][k - 1])) k -= 1;
  return k;
}

const named = ({ meter, customer, phase }) => `${deviceName(meter, customer)}${phase ? `, phase ${phase}` : ""}`;
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

export class Diagram {
  constructor({ onSelect }) {
    this.box = byId("diagram");
    this.tip = byId("tip");
    this.onSelect = onSelect;
    this.scale = new Scale();
    this.view = "line";
    this.selected = this.hovered = this.waiting = null;
    this.drawn = "";
    this.opened = new Set(); // Customers of branches that the operator expanded.
    this.last = new Map(); // Time of the last tick at which a customer was suspect, Unix s.
    this.beyond = new Map(); // The same for a voltage beyond the limits.
    this.viewport = new Viewport(this.box, () => this.moved());
    new ResizeObserver(() => {
      if (this.feeder && this.drawn !== this.window().key) this.build();
    }).observe(this.box);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      this.scale.theme();
      if (this.feeder) this.scale.draw();
      this.paint();
    });
    for (const button of byId("view").querySelectorAll("button")) {
      button.addEventListener("click", () => this.look(button.dataset.view));
    }
    const press = { "zoom-in": () => this.viewport.step(1), "zoom-out": () => this.viewport.step(-1), "zoom-reset": () => this.aim(), outside: () => this.aim(), branches: () => this.toggle() };
    for (const [id, act] of Object.entries(press)) byId(id).addEventListener("click", act);
    this.box.addEventListener("keydown", (event) => { if (event.key === "0") this.aim(); });
    byId("legend").replaceChildren(...LEGEND.map(([key, text]) => el("li", {},
      svg("svg", { viewBox: "-14 -14 28 28", "aria-hidden": true },
        svg("g", { class: "customer", "data-status": key }, svg("path", { class: "shape", d: SHAPE[key] }),
          svg("text", { class: "sign", y: 5, text: SIGN[key] ?? "" }))),
      text)), el("li", {}, el("span", { class: "present" }), "range of the present voltages"));
  }

  show(feeder) {
    this.feeder = feeder;
    this.limits = { low: feeder.v_min_volt, high: feeder.v_max_volt };
    this.nominal = nominals(feeder);
    this.level = new Set(this.nominal.values()).size > 1 ? null : feeder.v_nominal_volt;
    this.report = null;
    this.opened.clear();
    this.last.clear();
    this.beyond.clear();
    this.whole = this.collapsible = false; // All branches are expanded; some collapse.
    this.mapped = hasMap(feeder.layout);
    byId("view").hidden = !this.mapped;
    byId("busbar-name").textContent = `Busbar (${feeder.layout.buses[0]})`;
    this.cut = sharedPrefix(feeder.layout.customers.map((c) => c.customer));
    const { v_nominal_volt: nominal } = feeder;
    this.scale.open({ low: this.limits.low / nominal, high: this.limits.high / nominal }, this.level);
    this.look(this.mapped ? "map" : "line");
  }

  clear() {
    this.feeder = this.report = this.customers = null;
    this.hover(null);
    this.box.replaceChildren();
    byId("scale").replaceChildren();
    byId("busbar-name").textContent = "";
    for (const id of ["view", "zoom", "outside", "branches"]) byId(id).hidden = true;
  }

  look(view) {
    this.view = view;
    for (const button of byId("view").querySelectorAll("button")) {
      button.setAttribute("aria-pressed", String(button.dataset.view === view));
    }
    this.build();
  }

  // Size of the window of the drawing, px.
  window() {
    const width = Math.max(280, this.box.clientWidth);
    const height = Math.round(clamp(innerHeight * 0.56, 300, 680));
    return { width, height, key: `${width >> 3} ${height >> 4}` };
  }

  // Customers that never collapse: suspects, until a short time ago, and those that the operator has chosen.
  // Customers beyond the limits collapse only if the drawing does not fit otherwise.
  standing() {
    const now = this.report?.t ?? 0;
    const names = this.feeder.layout.customers.map(({ customer }) => customer);
    const recent = (times, name) => Math.abs(now - (times.get(name) ?? -Infinity)) <= HOLD_S;
    const which = (test) => new Set([...names.keys()].filter((k) => test(names[k])));
    return {
      shown: which((name) => this.opened.has(name) || name === this.selected || recent(this.last, name)),
      beyond: which((name) => recent(this.beyond, name)),
    };
  }

  standingKey() {
    const { shown, beyond } = this.standing();
    return `${[...shown]} | ${[...beyond]}`;
  }

  places() {
    const window = this.window();
    this.stood = this.standingKey();
    if (this.view === "map") return mapPlaces(this.feeder.layout, window);
    return onePlaces(this.feeder.layout, window, { ...this.standing(), whole: this.whole });
  }

  // Draw again if other branches collapse now.
  relayout() {
    if (this.view === "map" || !this.feeder) return;
    if (this.stood === this.standingKey()) return; // The same customers stand out.
    const places = this.places();
    if (this.signature(places) !== this.signature(this.placed)) this.build(places);
  }

  signature({ stubs, spots }) {
    return `${stubs.map((stub) => `${stub.key}:${stub.customers.length}`).join()} ${spots.length}`;
  }

  // ------------------------------------------------------------- the drawing

  build(places = this.places()) {
    const focused = this.box.contains(document.activeElement);
    const window = this.window();
    this.drawn = window.key;
    this.placed = places;
    this.lines = [];
    this.customers = new Map();
    this.stubs = [];
    const height = Math.round(Math.min(window.height, Math.max(places.world.height, 120)));
    const [casing, wires, spots] = [svg("g", {}), svg("g", {}), svg("g", {})];
    for (const wire of places.wires) {
      if (wire.kind === "tie") {
        casing.append(svg("path", { class: "tie", d: wire.d }));
        continue;
      }
      const path = svg("path", { class: `wire ${wire.kind ?? ""}`, d: wire.d });
      this.lines.push({ path, bus: wire.bus });
      casing.append(svg("path", { class: `casing ${wire.kind ?? ""}`, d: wire.d }));
      wires.append(path);
    }
    if (places.station) spots.append(this.symbol({ class: "station", ...places.station }, svg("path", { class: "shape", d: STATION })));
    this.order = [...places.spots, ...places.stubs].sort((a, b) => a.order - b.order)
      .map((spot) => (spot.key ? this.stub(spot) : this.spot(spot)));
    this.order.forEach(({ group }, k) => {
      group.setAttribute("tabindex", k === 0 ? 0 : -1);
      spots.append(group);
    });
    this.liar = this.symbol({ class: "busbar-liar", role: "img", hidden: true, ...places.busbar },
      svg("path", { class: "shape", d: SHAPE.suspect }), svg("text", { class: "sign", y: 5, text: SIGN.suspect }), svg("text", { class: "note loud", x: 17, y: 4 }));
    spots.append(this.liar);
    this.spots = spots;
    this.world = svg("g", { class: this.customers.size > MANY ? "world many" : "world" }, casing, wires, spots);
    this.root = svg("svg", { width: window.width, height, role: "group", "aria-label": places.title, "aria-describedby": "meters-title" }, this.world);
    this.box.replaceChildren(this.root);
    this.box.classList.toggle("map", this.view === "map");
    byId("zoom").hidden = false;
    this.viewport.open(places.world, { width: window.width, height });
    this.hovered = null;
    this.tip.hidden = true;
    this.paint();
    this.aim();
    if (focused) this.order[0]?.group.focus();
  }

  // A symbol of constant size on the screen, at a place of the drawing.
  symbol({ x, y, ...attributes }, ...children) {
    return svg("g", { transform: `translate(${x} ${y})`, ...attributes }, svg("g", { class: "glyph" }, ...children));
  }

  spot(spot) {
    const customer = this.feeder.layout.customers[spot.customer];
    const [shape, sign, note] = [svg("path", { class: "shape" }), svg("text", { class: "sign", y: 5 }), svg("text", { class: "note" })];
    const group = this.symbol({ class: "customer", role: "button", "aria-label": `${named(customer)}: no data`, x: spot.x, y: spot.y,
      on: this.handlers(() => part, () => this.onSelect(customer.customer)) }, svg("circle", { class: "hit", r: 13 }), shape, sign);
    group.append(svg("g", { class: "still" }, note));
    const part = { id: customer.customer, customer, group, shape, sign, note, x: spot.x, y: spot.y, said: "" };
    this.customers.set(customer.customer, part);
    return part;
  }

  stub(stub) {
    const count = svg("text", { class: "count-text", y: 4.5, text: `▸ ${stub.customers.length}` });
    const group = this.symbol({ class: `stub ${stub.inline ? "inline" : ""}`, role: "button", "aria-expanded": "false", x: stub.x, y: stub.y,
      on: this.handlers(() => part, () => this.expand(part)) }, svg("path", { class: "shape", d: STUB }), count);
    const part = { id: stub.key, stub, group, count, shape: group.querySelector(".shape"), x: stub.x, y: stub.y, text: "" };
    this.stubs.push(part);
    return part;
  }

  handlers(part, act) {
    return {
      click: act,
      keydown: (event) => this.key(event, part(), act),
      pointerenter: (event) => this.hover(event.pointerType === "mouse" ? part() : null),
      pointerleave: () => this.hover(null),
      focus: () => {
        const visible = part().group.matches(":focus-visible");
        if (visible) this.viewport.reveal(part());
        this.hover(visible ? part() : null);
      },
      blur: () => this.hover(null),
    };
  }

  // ------------------------------------------------------- branches and view

  expand({ stub }) {
    const names = stub.customers.slice(0, OPENED).map((k) => this.feeder.layout.customers[k].customer);
    for (const name of names) this.opened.add(name);
    const { manual } = this.viewport;
    this.build();
    this.viewport.manual = manual;
    const part = this.customers.get(names[0]);
    part?.group.focus();
    if (part) this.viewport.reveal(part);
  }

  // Expand all branches, or collapse the quiet ones.
  toggle() {
    this.whole = this.placed.stubs.length > 0;
    this.opened.clear();
    this.build();
  }

  // Show the whole drawing; where it would be too small, the suspects.
  aim() {
    if (!this.feeder) return;
    const { viewport, placed: { world } } = this;
    const loud = this.loud();
    const all = { x: 0, y: 0, ...world };
    const whole = Math.min(1, viewport.size.width / world.width, viewport.size.height / world.height);
    const readable = this.view === "map" ? whole : 0.7;
    if (whole >= readable || (!loud.length && whole > 0.4)) viewport.fit(all);
    else if (!loud.length) viewport.fit({ x: 0, y: 0, width: viewport.size.width / 0.5, height: viewport.size.height / 0.5 });
    else {
      const [xs, ys] = [loud.map((p) => p.x), loud.map((p) => p.y)];
      const air = 70;
      const [x, y] = [Math.min(...xs) - air, Math.min(...ys) - air];
      viewport.fit({ x, y, width: Math.max(...xs) + air - x, height: Math.max(...ys) + air - y });
    }
  }

  // Drawn suspects.
  loud() {
    return [...(this.customers?.values() ?? [])].filter((part) => part.key === "suspect");
  }

  // The view has changed: sizes of the symbols, labels.
  moved() {
    const { k, dx, dy } = this.viewport;
    const { gap, pitch, size } = this.placed;
    const map = this.view === "map";
    const [quiet, loud] = map ? [clamp((gap * k) / 20, 0.4, 1), clamp((gap * k) / 20, 0.8, 1)] : [clamp(k * size, 0.5, 1.35), clamp(k * size, 0.75, 1.35)];
    this.world.setAttribute("transform", `translate(${dx} ${dy}) scale(${k})`);
    for (const [name, value] of [["--quiet-size", quiet / k], ["--loud-size", loud / k], ["--still", 1 / k]]) this.world.style.setProperty(name, value);
    this.sizes = { quiet, loud };
    this.world.classList.toggle("named", gap * k >= ROOM[0] && pitch * k >= ROOM[1] && !this.placed.upright);
    this.world.classList.toggle("thin", k < 0.6);
    if (this.hovered) this.hover(this.hovered);
    this.waiting ??= requestAnimationFrame(() => { this.waiting = null; this.label(); });
  }

  // Places of labels; suspects outside of the window are counted.
  label() {
    if (!this.feeder) return;
    const { viewport, sizes } = this;
    const all = this.loud();
    const seen = all.filter((part) => viewport.holds(part, -MARGIN / 3));
    const marks = seen.map((part) => ({ ...viewport.at(part), radius: 12 * sizes.loud, lines: part.lines }));
    const others = [...(this.customers?.values() ?? [])].filter((part) => part.key !== "suspect").map((part) => ({ ...viewport.at(part), radius: 8 * sizes.quiet }));
    others.push(...this.stubs.map((stub) => ({ ...viewport.at(stub), radius: 11 * sizes.loud, wide: 25 * sizes.loud })));
    const places = placeLabels(marks, others, viewport.size);
    seen.forEach(({ note }, k) => {
      const { x, y, anchor } = places[k];
      note.setAttribute("text-anchor", anchor);
      [...note.children].forEach((line, row) => { line.setAttribute("x", x); line.setAttribute("y", y + 13 * row); });
    });
    const outside = all.filter((part) => !viewport.holds(part, 4)).length;
    byId("outside").hidden = outside === 0;
    byId("outside").textContent = `${outside} suspect${outside === 1 ? "" : "s"} outside of the view: show`;
    const { stubs } = this.placed;
    if (stubs.length) this.collapsible = true;
    byId("branches").hidden = this.view === "map" || !this.collapsible;
    byId("branches").textContent = stubs.length ? `Expand ${stubs.length} branch${stubs.length === 1 ? "" : "es"}` : "Collapse quiet branches";
    byId("zoom-out").disabled = viewport.k <= viewport.least * 1.001;
  }

  // --------------------------------------------------------------- the states

  update(report) {
    this.report = report;
    this.meters = new Map(report.meters.map((meter) => [meter.meter, meter]));
    this.volts = new Map(report.buses.map((bus) => [bus.bus, bus.v_volt]));
    this.modelled = new Set(report.buses.filter((bus) => bus.model_only).map((bus) => bus.bus));
    this.customersModelled = new Set((report.customers ?? []).filter((c) => c.model_only).map((c) => c.customer));
    this.phases = new Map(report.buses.map((bus) => [bus.bus, bus.v_phases]));
    const parts = [...this.volts].filter(([bus]) => !this.modelled.has(bus)).map(([bus, v]) => this.part(bus, v)).filter(isKnown);
    parts.push(...report.meters.filter((m) => !m.model_only).map((m) => m.v2_pu_estimated).filter(isKnown).map(Math.sqrt));
    this.scale.mark(parts);
    const before = this.loud().length;
    const accused = new Set((report.inverters ?? []).filter((i) => i.suspect).map((i) => i.customer));
    for (const customer of this.feeder.layout.customers) {
      const { key } = status(this.meters.get(customer.meter), this.limits, report);
      if (key === "suspect" || accused.has(customer.customer)) this.last.set(customer.customer, report.t);
      if (key === "high" || key === "low") this.beyond.set(customer.customer, report.t);
    }
    this.relayout();
    this.paint();
    if (this.loud().length !== before && !this.viewport.manual) this.aim();
    if (this.hovered) this.hover(this.hovered);
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
    for (const line of this.lines) {
      const bus = buses[line.bus];
      const color = this.modelled.has(bus) ? "" : (this.scale.color(this.part(bus, this.volts.get(bus))) ?? "");
      if (line.color === color) continue;
      line.color = color;
      line.path.classList.toggle("unknown", color === "");
      line.path.style.stroke = color;
    }
    for (const part of this.customers.values()) this.paintCustomer(part);
    for (const part of this.stubs) this.paintStub(part);
    const busbar = this.report.busbar ?? {};
    const mark = busbar.suspect ? "◆ " : "";
    byId("busbar-name").textContent = `${mark}Busbar (${buses[0]}): ${volt(this.volts.get(buses[0]))}${this.modelled.has(buses[0]) ? " (model only)" : ""}`;
    byId("busbar-name").classList.toggle("suspect", Boolean(busbar.suspect));
    this.liar.toggleAttribute("hidden", !busbar.suspect);
    if (busbar.suspect) {
      this.liar.setAttribute("aria-label", busbarWords(busbar));
      this.liar.querySelector(".note").textContent = signed(busbar.attack_volt_estimated);
    }
    this.label();
  }

  paintCustomer(part) {
    const { customer } = part;
    const meter = this.meters.get(customer.meter);
    const now = status(meter, this.limits, this.report);
    const v = this.voltAt(customer);
    const alone = this.alone(customer);
    const fill = alone || PLAIN.has(now.key) ? "" : (this.scale.color(this.part(customer.bus, v)) ?? "");
    const loud = now.key === "suspect";
    const lines = loud ? [this.short(customer), signed(meter.attack_volt_estimated)] : [this.short(customer)];
    const text = `${named(customer)}: ${now.text}, ${alone ? "model only" : "reconstructed"} ${volt(v)}`;
    const said = JSON.stringify([text, fill, lines, customer.customer === this.selected]);
    if (said === part.said) return; // Unchanged symbols cost nothing.
    const { key } = part;
    Object.assign(part, { said, lines, key: now.key });
    part.group.setAttribute("data-status", now.key);
    part.shape.setAttribute("d", SHAPE[now.key]);
    part.shape.style.fill = fill;
    part.sign.textContent = SIGN[now.key] ?? "";
    part.note.classList.toggle("loud", loud);
    const beside = this.view === "map"; // A line mostly goes on below.
    part.note.setAttribute("text-anchor", beside ? "start" : "middle");
    part.note.replaceChildren(...lines.map((line, k) => svg("tspan", { x: beside ? 11 : 0, y: (beside ? 4 : 26) + 13 * k, text: line })));
    part.group.setAttribute("aria-label", text);
    part.group.classList.toggle("selected", customer.customer === this.selected);
    // Suspects cover their neighbours.
    if (loud && key !== "suspect" && document.activeElement !== part.group) this.spots.append(part.group);
  }

  // Name of a customer in the drawing: the id of its meter.
  short({ meter, customer }) {
    const name = meter ?? customer.slice(this.cut);
    return name.length > 10 ? `${name.slice(0, 9)}…` : name;
  }

  paintStub(part) {
    const names = this.feeder.layout.customers;
    const count = new Map();
    let [low, high] = [null, null];
    for (const customer of part.stub.customers.map((k) => names[k])) {
      const { key } = status(this.meters.get(customer.meter), this.limits, this.report);
      count.set(key, (count.get(key) ?? 0) + 1);
      const v = this.alone(customer) ? NaN : this.part(customer.bus, this.voltAt(customer));
      if (!isKnown(v)) continue;
      [low, high] = [Math.min(low ?? v, v), Math.max(high ?? v, v)];
    }
    const far = low === null ? NaN : Math.abs(low - 1) > Math.abs(high - 1) ? low : high;
    const color = this.scale.color(far) ?? "";
    if (part.color !== color) part.shape.style.stroke = part.color = color;
    const range = low === null ? "no voltage" : `reconstructed ${this.scale.text(low)} to ${this.scale.text(high)}`;
    const text = [`${part.stub.customers.length} customers`, ...Object.keys(WORDS).filter((key) => count.has(key)).map((key) => `${count.get(key)} ${WORDS[key]}`), range].join(", ");
    if (part.text === text) return;
    part.text = text;
    const worst = ["high", "low", "doubtful", "silent", "unjudged"].find((key) => count.has(key)) ?? "ok";
    part.group.setAttribute("data-status", worst);
    part.group.setAttribute("aria-label", `Collapsed branch: ${text}`);
    part.count.textContent = `▸ ${part.stub.customers.length}${{ ...SIGN, high: "▲", low: "▼" }[worst] ?? ""}`;
  }

  // ---------------------------------------------------------------- the operator

  select(id) {
    this.selected = id;
    this.tip.hidden = true;
    if (!this.feeder || !this.customers) return;
    if (id !== null) this.opened.add(id); // The drawing does not change when the panel closes.
    if (id !== null && !this.customers.has(id)) this.relayout();
    this.paint();
    if (id !== null && this.customers.has(id)) this.viewport.reveal(this.customers.get(id), 10);
  }

  key(event, part, act) {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      act();
    } else if (step && !event.shiftKey) {
      event.preventDefault();
      const { order } = this;
      const next = order[(order.indexOf(part) + step + order.length) % order.length];
      part.group.setAttribute("tabindex", -1);
      next.group.setAttribute("tabindex", 0);
      next.group.focus();
    }
  }

  hover(part) {
    this.hovered = part;
    this.tip.hidden = !part || part.id === this.selected || !this.report;
    if (this.tip.hidden) return;
    this.tip.replaceChildren(...(part.stub ? this.told(part) : this.readings(part.customer)));
    const card = this.tip.parentElement.getBoundingClientRect();
    const spot = part.group.getBoundingClientRect();
    const left = clamp(spot.left - card.left + spot.width / 2, 90, card.width - 90);
    this.tip.style.left = `${left}px`;
    this.tip.style.top = `${spot.top - card.top - 8}px`;
  }

  told({ text }) {
    const [count, ...rest] = text.split(", ");
    return [el("b", { text: `Collapsed branch, ${count}` }), ...rest.map((line) => el("span", { text: line }))];
  }

  readings(customer) {
    const meter = this.meters.get(customer.meter);
    const now = status(meter, this.limits, this.report);
    return [
      el("b", { text: deviceName(customer.meter, customer.customer) }),
      ...(customer.phase ? [el("span", { text: `phase ${customer.phase}` })] : []),
      el("span", { class: "state", "data-status": now.key, text: now.text }),
      el("span", { text: `reported ${volt(meter?.v_volt_reported)}` }),
      el("span", { text: `${this.alone(customer) ? "model only" : "reconstructed"} ${volt(this.voltAt(customer))}` }),
    ];
  }
}
