// Status banner: displayed verdict, its start, its certainty, the next step, and all suspects.
// The displayed verdict changes only after the delays of the alarms; the verdict of the latest tick stands beside it.

import { APART, GUIDE, byId, clock, duration, el, isKnown, signed } from "./dom.js";
import { BUSBAR, customerName, meterName } from "./names.js";

const SHOWN = 8; // Suspects before the button for all.
const SIGNS = {
  clean: "M5 17l7 7L27 8",
  attacked: "M16 4L29 28H3zM16 12v8M16 23.500v.5",
  undecided: "M10 11a6 6 0 1 1 8 6q-2 1-2 4M16 26.500v.5",
  apart: "M16 5a11 11 0 1 0 .01 0M8.500 8.500l15 15",
  none: "M16 5a11 11 0 1 0 .01 0M16 9v7l5 3",
};
// Next step: sentence, and section of the operator guide.
const STEPS = {
  clean: ["No action is needed.", "verdict-clean"],
  meters: ["Use the reconstructed voltages, and have the named meters inspected.", "meter-manipulated"],
  inverters: ["Have the named inverters inspected, their settings first.", "inverter-manipulated"],
  both: ["Use the reconstructed voltages, and have the named devices inspected.", "manipulation"],
  files: ["Compare the named customers with the field first: the files may be wrong.", "errors-of-the-files"],
  nodata: ["Restore the connection of the meters.", "no-data"],
  stale: ["Check the service and its connection.", "no-data"],
};
// Next step of an undecided verdict by its cause; its section is `undecided-<cause>`.
const CAUSES = {
  settling: "Wait: the monitor has begun and settles.",
  "silent-meters": "Look for the readings of the silent meters.",
  "too-few-meters": "Restore the readings of the silent meters.",
  "no-busbar": "Restore the readings of the busbar meter.",
  "clock-offset": "Set the clock of the named meter.",
  "missing-powers": "Restore the power readings of the named customers.",
  ambiguous: "Inspect the candidates, the likeliest first.",
  "too-many-suspects": "Compare the files with the field, then have the meters inspected.",
  misfit: "Check neighbouring meters and the feeder's data; do not rely on the voltages.",
  "design-invalid": "Correct the feeder's files.",
  overload: "No meter is at fault: monitoring returns when the load of the service fits.",
  "no-owner": "Wait: another process takes the feeder over. Otherwise check the processes of the service.",
};

const percent = (share) => `${Math.round(100 * share)} %`;
const SILENT = 4; // Silent meters beyond this number are one button.

// The displayed verdict of a report; services of earlier versions send the raw one only.
export function displayed(report) {
  const named = report.meters.filter((m) => m.suspect).map((m) => m.meter);
  return report.displayed ?? {
    verdict: report.verdict, since: report.since, t: report.t, cause: report.cause, reason: report.reason,
    suspects: report.busbar?.suspect ? [...named, report.busbar.meter] : named,
    inverters: (report.inverters ?? []).filter((i) => i.suspect).map((i) => i.customer),
  };
}

function explanationWords(feeder, { meters, inverters, powers = [], probability }) {
  const of = (kind) => (customer) => `${kind} of ${customerName(feeder, customer)}`;
  const parts = [...meters.map((meter) => meterName(feeder, meter)), ...inverters.map(of("inverter")), ...powers.map(of("reported power"))];
  return `${parts.join(" and ")} (${percent(probability)})`;
}

// Certainty of the displayed verdict, from the numbers of the latest tick.
function certainty(report, shown, name) {
  const explained = (e) => explanationWords(report.feeder, e);
  const judged = report.meters.filter((m) => m.seen && isKnown(m.score) && isKnown(m.threshold) && m.threshold > 0);
  const ratio = (m) => m.score / m.threshold;
  const times = (value) => (value >= 10 ? String(Math.round(value)) : value.toFixed(1));
  const tested = `${judged.length} of ${report.meters.length} meters tested`;
  if (shown.verdict === "attacked") {
    const named = judged.filter((m) => shown.suspects.includes(m.meter));
    if (!named.length || report.verdict !== "attacked") return `${tested} at this tick.`;
    const strongest = named.reduce((a, b) => (ratio(b) > ratio(a) ? b : a));
    const rivals = report.explanations?.length ? ` Explanations: ${report.explanations.slice(0, 3).map(explained).join(", ")}.` : "";
    const much = ratio(strongest) > 1
      ? `Strongest evidence at this tick: ${name(strongest.meter)}, ${times(ratio(strongest))} times the largest score of an honest meter.`
      : `Named by earlier readings; at this tick the largest score is ${percent(ratio(strongest))} of its threshold (${name(strongest.meter)}).`;
    return `${much}${rivals}`;
  }
  if (shown.verdict === "clean") {
    if (!judged.length) return `${tested} at this tick.`;
    const largest = judged.reduce((a, b) => (ratio(b) > ratio(a) ? b : a));
    return `${tested}; largest score ${percent(ratio(largest))} of its threshold (${name(largest.meter)}).`;
  }
  if (APART[shown.cause]) return "Not evaluated: neither an attack nor its absence is established.";
  if (report.explanations?.length) return `Possible: ${report.explanations.slice(0, 3).map(explained).join(", or ")}.`;
  return `No answer: neither an attack nor its absence is established. ${tested}.`;
}

// Number of silent meters, with the longest silence.
function silence({ silent, meters }) {
  const longest = Math.max(...silent.map((s) => s.seconds ?? 0));
  const own = silent.filter((s) => s.meter !== BUSBAR).length;
  const busbar = own < silent.length ? " and the busbar meter" : "";
  return `${own} of ${meters.length} meters${busbar} silent, up to ${duration(longest)}`;
}

function stepOf(report, shown) {
  if (shown.verdict === "clean") return STEPS.clean;
  if (shown.verdict === "undecided") return undecided(shown.cause);
  if (report.data_error) return STEPS.files;
  if (shown.inverters.length) return shown.suspects.length ? STEPS.both : STEPS.inverters;
  return STEPS.meters;
}

function undecided(cause) {
  return CAUSES[cause] ? [CAUSES[cause], `undecided-${cause}`] : ["Do not rely on the voltages until the cause is found.", "undecided"];
}

export class Banner {
  constructor({ onSelect, onSeries }) {
    this.onSelect = onSelect; // Called with a customer.
    this.onSeries = onSeries; // Called with meters that belong to no customer.
    this.all = false; // All suspects are listed.
    this.offsets = new Map(); // Newest deviation of each suspect, V: an undecided tick may have none.
    this.feeder = null;
  }

  name(meter) {
    return meterName(this.feeder.name, meter);
  }

  decision(kind, word) {
    byId("verdict").dataset.verdict = kind;
    byId("sign").setAttribute("d", SIGNS[kind]);
    byId("decision").textContent = word;
  }

  next([sentence, section] = []) {
    byId("next").hidden = sentence === undefined;
    byId("next").replaceChildren(
      el("span", { text: `${sentence ?? ""} ` }),
      el("a", { href: `${GUIDE}#${section ?? ""}`, target: "_blank", rel: "noopener", text: "Operator guide" }));
  }

  // Title of the feeder, and its name if the title does not contain it.
  place({ name, title } = {}) {
    const also = title && name && !title.toLowerCase().includes(name.toLowerCase()) ? ` (${name})` : "";
    byId("place").textContent = `${title || name || ""}${also}`;
  }

  // Before the first tick, or with the reason why a feeder is not monitored; `cause` is the code of the reason.
  empty(reason, cause = null) {
    if (APART[cause]) this.decision("apart", APART[cause]);
    else this.decision("none", "NO DATA");
    byId("reason").textContent = reason;
    for (const id of ["since", "certainty"]) byId(id).textContent = "";
    this.next(CAUSES[cause] ? undecided(cause) : STEPS.nodata);
    this.offsets.clear();
    byId("chips").replaceChildren();
    byId("facts").replaceChildren();
  }

  // The values shown are old, or those of the model alone: the verdict must not look like one.
  old(word, reason, step) {
    this.decision("none", word);
    byId("reason").textContent = reason;
    for (const id of ["since", "certainty"]) byId(id).textContent = "";
    this.next(STEPS[step]);
  }

  // Returns the displayed verdict in capital letters.
  show(report, feeder, range) {
    if (feeder !== this.feeder) {
      Object.assign(this, { feeder, all: false });
      this.offsets.clear();
    }
    const shown = displayed(report);
    const apart = shown.verdict === "undecided" ? APART[shown.cause] : undefined;
    const word = apart ?? shown.verdict.toUpperCase();
    this.place(feeder);
    this.decision(apart ? "apart" : shown.verdict, word);
    const raw = report.verdict !== shown.verdict;
    byId("reason").textContent = raw ? shown.reason : report.reason;
    const since = isKnown(shown.since) ? `Since ${clock(shown.since)} (${duration(report.t - shown.since)}).` : "";
    const now = raw ? ` Latest tick: ${report.verdict}, ${report.cause.replaceAll("-", " ")}.` : "";
    byId("since").textContent = `${since}${now}`.trim();
    byId("certainty").textContent = certainty(report, shown, (meter) => this.name(meter));
    this.next(stepOf(report, shown));
    this.chips(report, shown);
    this.facts(report, shown, range);
    return word;
  }

  chips(report, shown) {
    const customer = new Map(this.feeder.layout.customers.map((c) => [c.meter, c.customer]));
    for (const m of [...report.meters, ...(report.busbar ? [report.busbar] : [])]) {
      if (m.suspect && isKnown(m.attack_volt_estimated)) this.offsets.set(m.meter, m.attack_volt_estimated);
    }
    const go = (meter) => (customer.has(meter) ? this.onSelect(customer.get(meter)) : this.onSeries([meter]));
    const chip = (kind, text, click) => el("button", { type: "button", class: "chip", "data-status": kind, text, on: { click } });
    const off = (meter) => (this.offsets.has(meter) ? ` ${signed(this.offsets.get(meter))} V` : "");
    const named = new Map((report.inverters ?? []).map((i) => [i.customer, i]));
    const kvar = (c) => (isKnown(named.get(c)?.attack_kvar_estimated) ? ` ${signed(named.get(c).attack_kvar_estimated)} kvar` : "");
    const accused = new Set([...shown.suspects, ...shown.inverters]);
    const candidates = shown.verdict === "undecided" ? (report.explanations ?? []).flatMap((e) => [...e.meters, ...e.inverters]) : [];
    const meters = new Set([...customer.keys(), BUSBAR]);
    const every = [
      ...shown.suspects.map((m) => chip("suspect", `${this.name(m)}${off(m)}`, () => go(m))),
      ...shown.inverters.map((c) => chip("suspect", `inverter of ${customerName(this.feeder.name, c)}${kvar(c)}`, () => this.onSelect(c))),
      ...[...new Set(candidates)].filter((one) => !accused.has(one)).map((one) =>
        chip("doubtful", `candidate ${meters.has(one) ? this.name(one) : `inverter of ${customerName(this.feeder.name, one)}`}`, () => (customer.has(one) || one === BUSBAR ? go(one) : this.onSelect(one)))),
      ...(report.silent.length > SILENT && !this.all
        ? [chip("silent", silence(report), () => this.unfold(report, shown))]
        : report.silent.map((s) => chip("silent", `${this.name(s.meter)} silent ${isKnown(s.seconds) ? duration(s.seconds) : ""}`, () => go(s.meter)))),
    ];
    const rest = every.length - SHOWN;
    const more = rest > 0
      ? [el("button", { type: "button", class: "plain", "aria-expanded": String(this.all), text: this.all ? "Show fewer" : `Show all ${every.length}`, on: { click: () => this.unfold(report, shown) } })]
      : [];
    byId("chips").replaceChildren(...(rest > 0 && !this.all ? every.slice(0, SHOWN) : every), ...more);
  }

  unfold(report, shown) {
    this.all = !this.all;
    this.chips(report, shown);
    byId("chips").lastElementChild.focus();
  }

  facts(report, shown, range) {
    const fact = (name, value) => el("div", {}, el("dt", { text: name }), el("dd", { text: value }));
    byId("facts").replaceChildren(
      fact("Meters available", `${report.meters.filter((m) => m.seen).length} of ${report.meters.length}`),
      fact("Suspects", String(shown.suspects.length + shown.inverters.length)),
      fact("Identifies up to", `${report.max_attacked} manipulated`),
      fact("Reconstructed voltages", range),
      fact("Tick", clock(report.t)));
  }
}

// The bar of a page without a connection; `state` is that of the link.
export function offline(state, report, age) {
  const lost = state === "lost";
  byId("offline").hidden = !lost;
  byId("main").dataset.link = lost ? "lost" : "up";
  if (!lost) return;
  const last = report ? `The page shows the state of ${clock(report.t)}, ${duration(age ?? 0)} ago.` : "No data has been received.";
  const text = `Not connected to the service. ${last} It connects again by itself.`;
  if (byId("offline").textContent !== text) byId("offline").textContent = text;
}

