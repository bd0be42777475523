// Commissioning: a line for the feeder, numbers for a meter, and the form for a replaced meter.

import { ask, post } from "./actions.js";
import { byId, deviceName, getJson, isKnown, signed } from "./dom.js";

const API = "/api/v1/feeders";
const EVERY_MS = 60000;
const REASON = {
  silent: "no readings",
  suspected: "meter suspect",
  "others-suspected": "other devices suspect",
  "no-busbar": "no busbar voltage",
  "unread-powers": "powers unread",
  "load-beyond-declared": "load beyond declared",
  "active-uncertainty": "active power uncertain",
  "reactive-uncertainty": "reactive power uncertain",
};

function hours(seconds) {
  const h = seconds / 3600;
  return h >= 10 || h < 0.05 || Number.isInteger(h) ? String(Math.floor(h)) : h.toFixed(1);
}

const day = (t) => new Date(t * 1000).toLocaleDateString();

const words = (reason) => REASON[reason] ?? reason;

// Sentence on the meters behind schedule, with their number for each reason, the most frequent first.
function delays(meters) {
  const late = meters.filter((m) => m.learning_state === "stalled" || m.learning_reason);
  if (!late.length) return "";
  const count = new Map();
  for (const m of late) count.set(m.learning_reason, (count.get(m.learning_reason) ?? 0) + 1);
  const why = [...count].sort(([, a], [, b]) => b - a).map(([reason, n]) => `${reason ? words(reason) : "reason unknown"} (${n})`);
  const stalled = late.filter((m) => m.learning_state === "stalled").length;
  return ` Delayed: ${late.length}${stalled ? `, stalled: ${stalled}` : ""}. Reasons: ${why.join(", ")}.`;
}

export class Commissioning {
  constructor({ onChange }) {
    this.onChange = onChange;
    this.feeder = null;
    this.known = null;
    setInterval(() => this.load(), EVERY_MS);
  }

  async watch(feeder) {
    this.feeder = feeder;
    this.take(null);
    await this.load();
  }

  async load() {
    const { feeder } = this;
    if (feeder === null) return;
    const found = await getJson(`${API}/${encodeURIComponent(feeder)}/commissioning`).catch(() => null);
    if (found !== null && feeder === this.feeder) this.take(found);
  }

  take(known) {
    this.known = known;
    byId("commissioning").textContent = this.line();
    this.onChange();
  }

  line() {
    const k = this.known;
    if (k === null || k.state === "off" || (k.state === "waiting" && !k.note)) return "";
    const note = k.note ? ` Restarted: ${k.note}.` : "";
    if (k.state === "learned") return `Meters' own errors learned on ${day(k.learned_at)}.${note}`;
    if (k.state === "waiting") return note.trim();
    const open = k.meters.filter((m) => m.state === "learning").length;
    const which = open === k.meters.length ? "meters" : `${open} of ${k.meters.length} meters`;
    const held = k.held ? " Waiting until no meter is suspect." : "";
    return `Learning ${which}, ${hours(k.gathered_s)} of ${hours(k.needed_s)} h.${delays(k.meters)}${held}${note}`;
  }

  // Label, value and remark for the panel of a meter; null if the estimator does not learn.
  of(meter) {
    const found = this.known?.meters.find((m) => m.meter === meter);
    if (!found) return null;
    if (found.state === "learning") {
      const why = found.learning_reason ? `: ${words(found.learning_reason)}` : "";
      const time = `${hours(found.gathered_s)} of ${hours(this.known.needed_s)} h gathered`;
      return ["Own error", "not learned yet", `${time}, ${found.learning_state}${why}`];
    }
    const since = isKnown(found.learned_at) ? `, learned on ${day(found.learned_at)}` : "";
    return ["Own error", `${signed(found.error_volt, 2)} V`, `± ${found.error_volt_std.toFixed(2)} V${since}`];
  }

  ask(meter, customer) {
    const { feeder } = this;
    ask({
      title: "Meter replaced",
      what: `Meter ${deviceName(meter, customer)} of ${feeder}: its own error is deleted and learned again, `
        + `over ${hours(this.known.needed_s)} h. The other meters stay unchanged.`,
      verb: "Learn anew",
      text: "Reason",
      needed: true,
      send: async (by, { text }) => {
        const body = await post(`${API}/${encodeURIComponent(feeder)}/commissioning`, { ...by, reason: text, meters: [meter] });
        if (body.feeder === this.feeder) this.take(body);
      },
    });
  }
}
