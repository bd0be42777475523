// Time series of meters: reported and reconstructed voltage with its uncertainty band, verdicts and alarms.
// One panel per meter over a common time axis; minimum and maximum of each pixel column.

import { bare, byId, clock, duration, el, getJson, isKnown, nominals, svg, volt } from "./dom.js";
import { BUSBAR, meterName, subjectOf } from "./names.js";

const API = "/api/v1/feeders";
const MOST = 6; // Meters in one chart.
const SPANS = [[3600, "1 h"], [21600, "6 h"], [86400, "24 h"], [604800, "7 d"], [1209600, "14 d"]];
const [SHORTEST_S, LONGEST_S] = [60, 1209600];
const [LEFT, RIGHT, LANE, ROW, GAP, AXIS] = [70, 12, 11, 9, 24, 22]; // Margins and heights, px.
const ALARM_ROWS = 4;
const TABLE_ROWS = 24; // Times in the table.
const STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400, 172800, 604800];
const VERDICTS = ["attacked", "undecided", "clean"];
const DRAG_PX = 6; // A shorter movement of the pointer is a click.
const NEAR_PX = 30; // Fingers that are nearer count as this far apart.
const WHEEL = 0.01; // Zoom by the pinch of a touchpad, per px.
const SETTLED_MS = 250; // Time after the last movement of a wheel before the data are loaded.

// ------------------------------------------------------------------- geometry

// Pixel columns [x, lowest, highest] in runs without a gap; times without a value are left out.
export function columns(t, low, high, { x, gap }) {
  const runs = [];
  let [run, before] = [null, -Infinity];
  for (let j = 0; j < t.length; j += 1) {
    const [a, b] = [low[j], high[j]];
    if (!isKnown(a) || !isKnown(b)) continue;
    const at = Math.round(x(t[j]));
    if (run === null || t[j] - before > gap) runs.push(run = []);
    const last = run.at(-1);
    if (last?.[0] === at) {
      last[1] = Math.min(last[1], a);
      last[2] = Math.max(last[2], b);
    } else run.push([at, a, b]);
    before = t[j];
  }
  return runs;
}

// A line through the extremes of each column, the nearer one first. A lone column is a dot.
export function line(runs, y) {
  const parts = [];
  for (const run of runs) {
    let last = null;
    for (const [x, low, high] of run) {
      const [a, b] = [y(low), y(high)];
      const near = last !== null && Math.abs(last - a) > Math.abs(last - b) ? [b, a] : [a, b];
      parts.push(last === null ? "M" : "L", x, " ", near[0].toFixed(1));
      if (last === null) parts.push("h0");
      if (Math.abs(a - b) >= 0.05) parts.push("V", near[1].toFixed(1));
      [, last] = near;
    }
  }
  return parts.join("");
}

// The area between the extremes.
export function area(runs, y) {
  return runs.map((run) => {
    const wide = run.length > 1 ? run : [[run[0][0] - 1, run[0][1], run[0][2]], [run[0][0] + 1, run[0][1], run[0][2]]];
    const top = wide.map(([x, , high]) => `${x} ${y(high).toFixed(1)}`);
    const bottom = wide.toReversed().map(([x, low]) => `${x} ${y(low).toFixed(1)}`);
    return `M${[...top, ...bottom].join("L")}Z`;
  }).join("");
}

// Round values between two ends, at most `most`.
export function ticks(low, high, most) {
  const rough = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= rough);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) found.push(k * step);
  return { found, digits };
}

// Round local times between two ends, at most `most`.
export function times(since, until, most) {
  const step = STEPS_S.find((s) => (until - since) / s <= most) ?? STEPS_S.at(-1);
  const found = [];
  const first = new Date(since * 1000);
  first.setHours(0, 0, 0, 0);
  if (step >= 86400) {
    const day = new Date(first);
    for (; day / 1000 < until; day.setDate(day.getDate() + step / 86400)) if (day / 1000 >= since) found.push(day / 1000);
    return { found, step };
  }
  // Midnight by midnight: days with a change of daylight saving time have 23 or 25 hours.
  for (const day = first; day / 1000 < until; day.setDate(day.getDate() + 1)) {
    const next = new Date(day);
    next.setDate(next.getDate() + 1);
    // Steps of hours are hours of the clock: it repeats one, or leaves one out, at a change.
    const hour = step > 3600 ? (k) => new Date(day).setHours((k * step) / 3600) / 1000 : (k) => day / 1000 + k * step;
    for (let k = 0, t = hour(0); t < Math.min(until, next / 1000); k += 1, t = hour(k)) if (t >= since) found.push(t);
  }
  return { found, step };
}

function labelOf(t, step) {
  const date = new Date(t * 1000);
  const midnight = date.getHours() + date.getMinutes() + date.getSeconds() === 0;
  if (midnight || step >= 86400) return date.toLocaleDateString([], { day: "numeric", month: "short" });
  return date.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", hour12: false, ...(step < 60 ? { second: "2-digit" } : {}) });
}

const moment = (t) => new Date(t * 1000).toLocaleString([], { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", second: "2-digit", hour12: false });
const between = (low, high, digits = 2) => (!isKnown(low) ? "–" : high - low < 0.005 ? bare(low, digits) : `${bare(low, digits)} to ${bare(high, digits)}`);

// Lowest and highest of the buckets [from, to) of a meter.
function extremes(meter, name, from, to) {
  const pick = (end) => meter[`v_volt_${name}_${end}`].slice(from, to).filter(isKnown);
  const [low, high] = [pick("min"), pick("max")];
  return low.length ? [low.reduce((a, b) => Math.min(a, b)), high.reduce((a, b) => Math.max(a, b))] : [null, null];
}

// Verdict with the longest time, and all others that occur.
function verdictOf(data, from, to) {
  const sums = VERDICTS.map((name) => [name, data[`${name}_s`].slice(from, to).reduce((a, b) => a + b, 0)]);
  const total = sums.reduce((sum, [, s]) => sum + s, 0) || 1;
  const there = sums.filter(([, s]) => s > 0).sort(([, a], [, b]) => b - a);
  return there.map(([name, s]) => (s === total ? name : `${name} ${Math.max(1, Math.round((100 * s) / total))} %`)).join(", ");
}

// --------------------------------------------------------------------- series

export class Series {
  constructor({ onChange }) {
    this.onChange = onChange; // Called after a change of the choice, for the address.
    this.feeder = null;
    this.report = null;
    this.turn = 0;
    this.pointer = null; // Its place over the chart.
    this.fingers = new Map(); // Pressed pointers and their places.
    this.pinch = null; // Distance and middle of two fingers at their press, and the span at that time.
    this.frame = null;
    this.close({ quiet: true });
    byId("series-spans").replaceChildren(...SPANS.map(([s, text]) =>
      el("button", { type: "button", "data-span": s, text, on: { click: () => this.choose(s) } })));
    const on = (id, act) => byId(id).addEventListener("click", act);
    on("series-in", () => this.zoom(0.5));
    on("series-out", () => this.zoom(2));
    on("series-back", () => this.move(-0.5));
    on("series-forth", () => this.move(0.5));
    on("series-now", () => this.now());
    on("series-close", () => this.close());
    byId("series-add").addEventListener("change", (event) => this.add(event.target.value));
    // Folded, the table is invisible, and screen readers have it all the same.
    on("series-table", () => {
      const unseen = byId("series-box").classList.toggle("unseen");
      byId("series-table").setAttribute("aria-expanded", String(!unseen));
    });
    this.chart = byId("series-chart");
    this.chart.addEventListener("keydown", (event) => this.key(event));
    this.chart.addEventListener("pointerdown", (event) => this.press(event));
    this.chart.addEventListener("pointermove", (event) => this.point(event));
    this.chart.addEventListener("pointerup", (event) => this.release(event));
    this.chart.addEventListener("pointercancel", (event) => this.release(event, { cancelled: true }));
    this.chart.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    this.chart.addEventListener("touchmove", (event) => { if (event.touches.length > 1) event.preventDefault(); }, { passive: false });
    this.chart.addEventListener("pointerleave", () => this.unpoint());
    this.chart.addEventListener("dblclick", () => this.now());
    new ResizeObserver(() => {
      if (this.data && Math.abs(this.chart.clientWidth - this.width) > 4) this.draw();
    }).observe(this.chart);
    setInterval(() => this.follow(), 1000);
  }

  // ------------------------------------------------------------ the choice

  // The feeder is shown: an address restores its series.
  watch(feeder, query) {
    this.feeder = feeder;
    this.report = null;
    this.close({ quiet: true });
    if (feeder) this.restore(query);
  }

  restore(query) {
    const known = new Set(this.meters_());
    const meters = (query.get("series") ?? "").split(",").filter((meter) => known.has(meter)).slice(0, MOST);
    const number = (name) => (query.get(name) ? Number(query.get(name)) : NaN);
    const [span, until] = [number("span"), number("until")];
    if (!meters.length) {
      if (this.chosen.length) this.close({ quiet: true });
      return;
    }
    this.show({ meters, span: span >= SHORTEST_S && span <= LONGEST_S ? span : 3600, until: until > 0 ? until : null });
  }

  // Parameters of the address; empty while closed.
  query() {
    if (!this.chosen.length) return "";
    const end = this.until === null ? "" : `&until=${Math.round(this.until)}`;
    return `series=${this.chosen.join(",")}&span=${Math.round(this.span)}${end}`;
  }

  // Show meters; without a time the span that was chosen last, up to now.
  open(meters, { since = null, until = null } = {}) {
    const end = until ?? null;
    const span = since === null ? this.span : Math.min(LONGEST_S, Math.max(SHORTEST_S, (end ?? this.present()) - since));
    this.show({ meters: meters.slice(0, MOST), span, until: end });
    byId("series").scrollIntoView({ block: "nearest" });
    byId("series-title").focus({ preventScroll: true });
  }

  show({ meters, span, until }) {
    Object.assign(this, { chosen: meters, span, until, data: null });
    byId("series").hidden = false;
    this.changed();
  }

  close({ quiet = false } = {}) {
    Object.assign(this, { chosen: [], span: this.span ?? 3600, until: null, data: null, loaded: -Infinity, drag: null });
    this.turn += 1;
    byId("series").hidden = true;
    byId("series-chart").replaceChildren();
    if (!quiet) this.onChange();
  }

  meters_() {
    return [...this.feeder.layout.customers.map((c) => c.meter).filter(Boolean), BUSBAR];
  }

  // Id of a meter, then its customer.
  name(meter) {
    return meterName(this.feeder.name, meter);
  }

  // Device of an alarm, empty for the whole feeder.
  subject(alarm) {
    return subjectOf({ feeder: this.feeder.name, ...alarm });
  }

  add(meter) {
    if (meter && !this.chosen.includes(meter) && this.chosen.length < MOST) {
      this.chosen = [...this.chosen, meter];
      this.changed();
    }
  }

  remove(meter) {
    this.chosen = this.chosen.filter((one) => one !== meter);
    if (this.chosen.length) this.changed();
    else this.close();
  }

  choose(span) {
    Object.assign(this, { span, until: null });
    this.changed();
  }

  now() {
    const whole = SPANS.find(([s]) => s >= this.span - 1)?.[0] ?? LONGEST_S;
    this.choose(whole);
  }

  // Newest tick by the service's clock, s.
  present() {
    return this.report ? this.report.t + 0.5 * (this.feeder?.tick_s ?? 1) : this.data?.until ?? Date.now() / 1000;
  }

  range() {
    const until = this.until ?? this.present();
    return [until - this.span, until];
  }

  set(since, until) {
    const span = Math.min(LONGEST_S, Math.max(SHORTEST_S, until - since));
    const middle = 0.5 * (since + until);
    const end = middle + 0.5 * span;
    this.until = end >= this.present() - 0.01 * span ? null : end;
    this.span = span;
    this.changed();
  }

  zoom(factor) {
    const [since, until] = this.range();
    const middle = this.until === null ? until : 0.5 * (since + until);
    const [a, b] = [middle - (middle - since) * factor, middle + (until - middle) * factor];
    this.set(a, b);
  }

  move(share) {
    const [since, until] = this.range();
    this.set(since + share * this.span, until + share * this.span);
  }

  changed() {
    this.tools();
    this.onChange();
    if (this.data) { // The loaded data stand on the chosen axis until the others come.
      const [from, to] = this.range();
      this.data = { ...this.data, from, to };
      this.draw();
    }
    this.load();
  }

  // ---------------------------------------------------------------- the data

  // A new tick of the feeder.
  take(report) {
    const first = this.report === null;
    this.report = report;
    if (first && this.chosen.length) this.load();
  }

  follow() {
    if (!this.chosen.length || this.until !== null || document.visibilityState === "hidden") return;
    const every = Math.min(60, Math.max(5, this.span / 700));
    if ((performance.now() - this.loaded) / 1000 >= every) this.load();
  }

  async load() {
    if (this.report === null) return; // Without a tick there is no present time.
    this.loaded = performance.now();
    this.turn += 1;
    const { turn, feeder } = this;
    const [since, until] = this.range();
    const room = Math.max(100, Math.min(2000, Math.round(this.chart.clientWidth - LEFT - RIGHT)));
    const query = new URLSearchParams({ since: since.toFixed(3), until: until.toFixed(3), buckets: room });
    for (const meter of this.chosen) query.append("meter", meter);
    const found = await getJson(`${API}/${encodeURIComponent(feeder.name)}/series?${query}`).catch((error) => error);
    if (turn !== this.turn) return; // The response belongs to an earlier choice.
    byId("series-error").hidden = !(found instanceof Error);
    if (found instanceof Error) {
      byId("series-error").textContent = `Time series not loaded: ${found.message}`;
      return;
    }
    this.data = { ...found, from: since, to: until };
    this.draw();
    this.table();
  }

  // ------------------------------------------------------------- the drawing

  tools() {
    for (const button of byId("series-spans").children) {
      button.setAttribute("aria-pressed", String(this.until === null && Number(button.dataset.span) === this.span));
    }
    byId("series-now").disabled = this.until === null && SPANS.some(([s]) => s === this.span);
    byId("series-forth").disabled = this.until === null;
    byId("series-out").disabled = this.span >= LONGEST_S;
    byId("series-in").disabled = this.span <= SHORTEST_S;
    byId("series-meters").replaceChildren(...this.chosen.map((meter) => el("button", {
      type: "button", class: "chip", text: `${this.name(meter)} ✕`, "aria-label": `Remove ${this.name(meter)}`, on: { click: () => this.remove(meter) },
    })));
    const others = this.meters_().filter((meter) => !this.chosen.includes(meter));
    byId("series-add").disabled = this.chosen.length >= MOST;
    byId("series-add").replaceChildren(
      el("option", { value: "", text: this.chosen.length >= MOST ? `At most ${MOST} meters` : "Add a meter …" }),
      ...others.map((meter) => el("option", { value: meter, text: this.name(meter) })));
  }

  // Permitted voltages at a meter, V.
  limits(meter) {
    const own = this.report?.meters.find((m) => m.meter === meter);
    return [own?.v_min_volt ?? this.feeder.v_min_volt, own?.v_max_volt ?? this.feeder.v_max_volt];
  }

  // Nominal voltage at a meter, V: meters of one level have a common scale.
  level(meter) {
    const bus = this.feeder.layout.customers.find((c) => c.meter === meter)?.bus;
    return nominals(this.feeder).get(bus) ?? this.feeder.v_nominal_volt;
  }

  // Common scale of the meters of each nominal voltage.
  scales() {
    const found = new Map();
    for (const meter of this.data.meters) {
      const level = this.level(meter.meter);
      const values = ["reported", "estimated", "band"].flatMap((name) => extremes(meter, name)).filter(isKnown);
      found.set(level, [...(found.get(level) ?? []), ...values]);
    }
    return new Map([...found].map(([level, values]) => {
      const [low, high] = values.length ? [Math.min(...values), Math.max(...values)] : [0.98 * level, 1.02 * level];
      const air = Math.max(0.06 * (high - low), 0.0008 * level);
      return [level, [low - air, high + air]];
    }));
  }

  draw() {
    const { data } = this;
    this.width = this.chart.clientWidth;
    const width = Math.max(280, this.width);
    const right = width - RIGHT;
    const x = (t) => LEFT + ((t - data.from) / (data.to - data.from)) * (right - LEFT);
    const gap = data.bucket_s + 2.5 * Math.max(data.step_s, this.feeder.tick_s ?? 1);
    this.x = x;
    const high = this.data.meters.length > 3 ? 110 : width < 600 ? 130 : 160;
    const lanes = this.lanes(x, gap, right);
    const top = lanes.height + GAP;
    const scales = this.scales();
    const panels = data.meters.map((meter, k) =>
      this.panel(meter, { x, gap, right, top: top + k * (high + GAP), high, range: scales.get(this.level(meter.meter)) }));
    const bottom = top + data.meters.length * (high + GAP) - GAP;
    const axis = this.axis(x, { top, bottom, right });
    this.bottom = bottom;
    const cursor = svg("line", { class: "cursor", y1: 0, y2: bottom, visibility: "hidden" });
    const chosen = svg("rect", { class: "chosen", y: 0, height: bottom, visibility: "hidden" });
    const words = `Reported and reconstructed voltage of ${data.meters.map((m) => this.name(m.meter)).join(", ")}, ${moment(data.from)} to ${moment(data.to)}. The table below has the numbers.`;
    const [drawing, tip] = [
      svg("svg", { class: "series-plot", width, height: bottom + AXIS, role: "img", "aria-label": words }, ...axis, ...lanes.nodes, ...panels, chosen, cursor),
      el("div", { class: "series-tip", hidden: true }),
    ];
    Object.assign(this, { cursor, chosenBox: chosen, tip });
    this.chart.replaceChildren(drawing, tip);
    if (this.pointer) this.readout(this.pointer);
    const left = data.complete ? "" : " Older ticks are left out.";
    const none = data.t.length ? "" : " No stored ticks in this time.";
    byId("series-state").textContent = `${moment(data.from)} to ${moment(data.to)}, local time${this.until === null ? ", following" : ""}; ${duration(Math.max(data.bucket_s, data.step_s))} per point.${none}${left}`;
  }

  // Verdicts, one row each, and alarms.
  lanes(x, gap, right) {
    const { data } = this;
    const nodes = [];
    VERDICTS.forEach((name, row) => {
      const base = (row + 1) * (LANE + 2);
      const parts = [];
      data.t.forEach((t, j) => {
        const all = data.clean_s[j] + data.attacked_s[j] + data.undecided_s[j];
        const share = all > 0 ? data[`${name}_s`][j] / all : 0;
        if (share <= 0) return;
        const following = data.t[j + 1] ?? Infinity;
        const end = following - t <= gap ? following : t + data.bucket_s;
        const [a, b] = [Math.max(LEFT, x(t)), Math.min(right, Math.max(x(end), x(t) + 1))];
        const h = Math.max(2, share * LANE);
        if (b > a) parts.push(`M${a.toFixed(1)} ${base}V${(base - h).toFixed(1)}H${b.toFixed(1)}V${base}Z`);
      });
      nodes.push(
        svg("line", { class: "base", x1: LEFT, x2: right, y1: base, y2: base }),
        svg("text", { class: "axis", x: LEFT - 6, y: base - 1, "text-anchor": "end", text: name }),
        svg("path", { class: `verdicts ${name}`, d: parts.join("") }));
    });
    const begin = VERDICTS.length * (LANE + 2) + 6;
    const ends = [];
    const more = { count: data.more_alarms ? 1 : 0 };
    for (const alarm of data.alarms) {
      const [a, b] = [Math.max(LEFT, x(alarm.t_raised)), Math.min(right, alarm.t_cleared === null ? right : Math.max(x(alarm.t_cleared), LEFT))];
      if (x(alarm.t_raised) > right || (alarm.t_cleared !== null && x(alarm.t_cleared) < LEFT)) continue;
      const drawn = Math.max(b, a + 5);
      let row = ends.findIndex((end) => end <= a);
      if (row < 0) row = ends.length;
      if (row >= ALARM_ROWS) { more.count += 1; continue; }
      ends[row] = drawn + 2;
      const y = begin + row * ROW;
      const about = this.subject(alarm);
      const what = `${alarm.kind}${about ? `, ${about}` : ""}: ${moment(alarm.t_raised)}, ${alarm.t_cleared === null ? "active" : `cleared ${moment(alarm.t_cleared)}`}`;
      nodes.push(svg("g", { class: `alarm-span ${alarm.severity}${this.chosen.includes(alarm.meter) ? " own" : ""}` },
        svg("title", { text: what }),
        svg("rect", { x: a.toFixed(1), y, width: (drawn - a).toFixed(1), height: ROW - 3, rx: 2 }),
        x(alarm.t_raised) >= LEFT ? svg("path", { class: "edge", d: `M${a.toFixed(1)} ${y - 1.5}v${ROW}` }) : null));
    }
    const rows = Math.max(1, ends.length);
    const label = ["alarms", more.count ? `+ ${more.count}` : ""];
    nodes.push(...label.filter(Boolean).map((text, k) => svg("text", { class: "axis", x: LEFT - 6, y: begin + 7 + 11 * k, "text-anchor": "end", text })));
    return { nodes, height: begin + Math.max(rows * ROW, more.count ? 20 : 9) };
  }

  panel(meter, { x, gap, right, top, high, range: [low, up] }) {
    const y = (v) => top + ((up - v) / (up - low)) * high;
    const { t: begins, bucket_s: bucket } = this.data;
    const t = begins.map((begin) => begin + 0.5 * Math.min(bucket, 0.5 * gap));
    const of = (name) => columns(t, meter[`v_volt_${name}_min`], meter[`v_volt_${name}_max`], { x, gap });
    const marks = ticks(low, up, Math.max(2, Math.floor(high / 32)));
    const [least, most] = this.limits(meter.meter);
    const inside = (v) => isKnown(v) && v > low && v < up;
    const named = begins.map((begin, j) => (meter.suspect[j] ? `M${Math.max(LEFT, x(begin)).toFixed(1)} ${top + high - 2}H${Math.min(right, Math.max(x(begin) + 1, x((begins[j + 1] ?? Infinity) - begin <= gap ? begins[j + 1] : begin + bucket))).toFixed(1)}` : "")).join("");
    const clip = `series-${top}`;
    return svg("g", { class: "panel" },
      svg("clipPath", { id: clip }, svg("rect", { x: LEFT, y: top, width: right - LEFT, height: high })),
      ...marks.found.flatMap((v) => [
        svg("line", { class: "grid", x1: LEFT, x2: right, y1: y(v), y2: y(v) }),
        svg("text", { class: "axis", x: LEFT - 6, y: y(v) + 4, "text-anchor": "end", text: volt(v, marks.digits) })]),
      ...[["lower limit", least], ["upper limit", most]].filter(([, v]) => inside(v)).flatMap(([text, v]) => [
        svg("line", { class: "limit", x1: LEFT, x2: right, y1: y(v), y2: y(v) }),
        svg("text", { class: "axis limit-name", x: right - 4, y: y(v) - 3, "text-anchor": "end", text })]),
      svg("rect", { class: "frame", x: LEFT, y: top, width: right - LEFT, height: high }),
      svg("g", { "clip-path": `url(#${clip})` },
        svg("path", { class: "band", d: area(of("band"), y) }),
        svg("path", { class: "estimated", d: line(of("estimated"), y) }),
        svg("path", { class: "reported", d: line(of("reported"), y) }),
        svg("path", { class: "named", d: named })),
      svg("text", { class: "meter-name", x: LEFT, y: top - 6, text: this.name(meter.meter) }));
  }

  axis(x, { top, bottom, right }) {
    const { found, step } = times(this.data.from, this.data.to, Math.max(2, Math.floor((right - LEFT) / 64)));
    return [
      ...found.flatMap((t) => [
        svg("line", { class: "grid", x1: x(t), x2: x(t), y1: top, y2: bottom + 4 }),
        svg("text", { class: "axis", x: Math.min(Math.max(x(t), LEFT + 10), right + RIGHT - 26), y: bottom + 17, "text-anchor": "middle", text: labelOf(t, step) })]),
      svg("text", { class: "axis", x: LEFT - 22, y: bottom + 17, "text-anchor": "end", text: "local" }),
    ];
  }

  // ------------------------------------------------------ pointer and keyboard

  time(event) {
    const at = event.clientX - this.chart.getBoundingClientRect().left;
    const [a, b] = [LEFT, Math.max(280, this.width) - RIGHT];
    const share = (Math.min(b, Math.max(a, at)) - a) / (b - a);
    return this.data.from + share * (this.data.to - this.data.from);
  }

  press(event) {
    if (!this.data || event.button !== 0) return;
    if (event.isPrimary) this.fingers.clear();
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (event.pointerType === "touch") this.chart.setPointerCapture(event.pointerId);
    this.forget();
    if (this.fingers.size === 1) this.drag = { x: event.clientX, t: this.time(event), id: event.pointerId };
    if (this.fingers.size !== 2) return;
    this.unpoint();
    const { data, grip } = this;
    this.pinch = { span: data.to - data.from, apart: grip.apart, t: data.from + grip.share * (data.to - data.from) };
  }

  // Distance of two fingers, px, and their middle as a share of the width of the plot.
  get grip() {
    const [a, b] = [...this.fingers.values()];
    const wide = Math.max(280, this.width) - RIGHT - LEFT;
    const middle = 0.5 * (a.x + b.x) - this.chart.getBoundingClientRect().left - LEFT;
    return { apart: Math.max(NEAR_PX, Math.hypot(a.x - b.x, a.y - b.y)), share: middle / wide };
  }

  point(event) {
    if (!this.data) return;
    if (this.fingers.has(event.pointerId)) this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (this.pinch !== null) {
      const { pinch: { span, apart, t }, grip } = this;
      this.preview((span * apart) / grip.apart, t, grip.share);
      return;
    }
    const { drag } = this;
    if (drag !== null && Math.abs(event.clientX - drag.x) > DRAG_PX) {
      this.chart.setPointerCapture(drag.id);
      const [a, b] = [drag.t, this.time(event)].sort((p, q) => p - q).map(this.x);
      for (const [name, value] of Object.entries({ x: a, width: b - a, visibility: "visible" })) this.chosenBox.setAttribute(name, value);
    }
    this.pointer = { clientX: event.clientX, clientY: event.clientY };
    this.readout(this.pointer);
  }

  release(event, { cancelled = false } = {}) {
    const { drag, pinch } = this;
    this.fingers.delete(event.pointerId);
    this.forget();
    if (pinch !== null) {
      if (this.data) this.set(this.data.from, this.data.to);
      return;
    }
    if (cancelled || drag === null || !this.data || Math.abs(event.clientX - drag.x) <= DRAG_PX) return;
    const [a, b] = [drag.t, this.time(event)].sort((p, q) => p - q);
    this.set(a, b);
  }

  forget() {
    this.drag = null;
    this.pinch = null;
    this.chosenBox?.setAttribute("visibility", "hidden");
  }

  // The loaded data on another axis: the time t, s, stands at a share of the width. Responses under way are
  // dropped, since their axis is an earlier one; the end of the gesture loads again.
  preview(wanted, t, share) {
    this.turn += 1;
    const span = Math.min(LONGEST_S, Math.max(SHORTEST_S, wanted));
    const until = Math.min(this.present(), t + (1 - share) * span);
    this.data = { ...this.data, from: until - span, to: until };
    this.frame ??= requestAnimationFrame(() => { this.frame = null; if (this.data) this.draw(); });
  }

  // A touchpad: its pinch zooms, two fingers sideways move. The wheel scrolls the page.
  wheel(event) {
    if (!this.data || (!event.ctrlKey && Math.abs(event.deltaX) <= Math.abs(event.deltaY))) return;
    event.preventDefault();
    const { from, to } = this.data;
    const wide = Math.max(280, this.width) - RIGHT - LEFT;
    const t = this.time(event);
    const moved = event.ctrlKey ? 0 : ((to - from) * event.deltaX) / wide;
    this.preview((to - from) * (event.ctrlKey ? Math.exp(WHEEL * event.deltaY) : 1), t + moved, (t - from) / (to - from));
    clearTimeout(this.settled);
    this.settled = setTimeout(() => { if (this.data) this.set(this.data.from, this.data.to); }, SETTLED_MS);
  }

  unpoint() {
    this.pointer = null;
    this.cursor?.setAttribute("visibility", "hidden");
    if (this.tip) this.tip.hidden = true;
  }

  // Numbers of the bucket at the pointer.
  readout(event) {
    const { data, tip } = this;
    if (!data.t.length) return;
    const t = this.time(event);
    let k = data.t.findIndex((begin) => begin + data.bucket_s > t);
    if (k < 0) k = data.t.length - 1;
    if (k > 0 && t - data.t[k - 1] < data.t[k] - t) k -= 1;
    const at = this.x(data.t[k] + 0.5 * data.bucket_s);
    for (const [name, value] of Object.entries({ x1: at, x2: at, visibility: "visible" })) this.cursor.setAttribute(name, value);
    const rows = data.meters.map((meter) => {
      const [[r0, r1], [e0, e1], [b0, b1]] = ["reported", "estimated", "band"].map((name) => extremes(meter, name, k, k + 1));
      return el("span", {}, el("b", { text: this.name(meter.meter) }), ` reported ${between(r0, r1)} V, reconstructed ${between(e0, e1)} V${isKnown(b0) ? ` (band ${between(b0, b1)} V)` : ""}`);
    });
    tip.replaceChildren(el("b", { text: `${moment(data.t[k])} · ${verdictOf(data, k, k + 1)}` }), ...rows);
    tip.hidden = false;
    const room = this.chart.clientWidth;
    tip.style.left = `${Math.max(0, Math.min(room - tip.offsetWidth, at + 12 + tip.offsetWidth > room ? at - tip.offsetWidth - 12 : at + 12))}px`;
    tip.style.top = `${Math.max(0, Math.min(this.bottom - tip.offsetHeight, event.clientY - this.chart.getBoundingClientRect().top + 14))}px`;
  }

  key(event) {
    const act = {
      "+": () => this.zoom(0.5), "=": () => this.zoom(0.5), "-": () => this.zoom(2),
      ArrowLeft: () => this.move(-0.25), ArrowRight: () => this.move(0.25),
      PageUp: () => this.move(-1), PageDown: () => this.move(1), End: () => this.now(), 0: () => this.now(), Escape: () => this.now(),
    }[event.key];
    if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  }

  // --------------------------------------------------------------- the table

  table() {
    const { data } = this;
    if (!data) return;
    const each = Math.max(1, Math.ceil(data.t.length / TABLE_ROWS));
    const rows = [];
    for (let from = 0; from < data.t.length; from += each) {
      const to = Math.min(data.t.length, from + each);
      for (const meter of data.meters) {
        const cells = ["reported", "estimated", "band"].map((name) => extremes(meter, name, from, to));
        rows.push(el("tr", {},
          el("th", { scope: "row", text: moment(data.t[from]) }),
          el("td", { text: this.name(meter.meter) }),
          ...cells.map(([low, up]) => el("td", { class: "num", text: between(low, up) })),
          el("td", { text: meter.suspect.slice(from, to).some(Boolean) ? "suspect" : "" }),
          el("td", { text: verdictOf(data, from, to) })));
      }
    }
    byId("series-rows").replaceChildren(...rows);
    byId("series-alarms").replaceChildren(...data.alarms.map((alarm) => el("li", {
      text: `${alarm.kind}, ${this.subject(alarm) || "whole feeder"}, ${alarm.severity}: raised ${clock(alarm.t_raised, { day: true })}, ${alarm.t_cleared === null ? "active" : `cleared ${clock(alarm.t_cleared, { day: true })}`}`,
    })));
    byId("series-no-alarms").hidden = data.alarms.length > 0;
  }
}
