// Alarm list: loaded once, then updated by the event stream; actions on a single alarm, and its log.

import { ask, post } from "./actions.js";
import { byId, clock, duration, el, getJson, isKnown, settle, guideLink, signed, sinceNode, steady, volt } from "./dom.js";
import { meterName, subjectOf } from "./names.js";

const API = "/api/v1/alarms";
const KIND = {
  "meter-manipulated": "Meter manipulated",
  "inverter-manipulated": "Inverter manipulated",
  "voltage-limit": "Voltage limit",
  "data-loss": "Data loss",
  undecided: "Undecided",
  "learning-stalled": "Learning stalled",
  "clock-offset": "Clock offset",
  "identity-mismatch": "Identity mismatch",
};
// Actions on a single alarm: texts of the form, and the last part of the path.
const ACTIONS = {
  ack: { title: "Acknowledge alarm", verb: "Acknowledge" },
  unack: { title: "Withdraw acknowledgement", verb: "Withdraw" },
  comment: { title: "Comment on alarm", verb: "Add comment", needed: true },
};
const CHANGE = {
  raised: "raised", acknowledged: "acknowledged", cleared: "cleared", updated: "evidence updated",
  unacknowledged: "acknowledgement withdrawn", commented: "comment",
};
const LISTED = 5; // Largest number of meters in the text of an alarm.
const PAGE = 50;
const EVERY_MS = 5000;
const SOON_MS = 200;

// Meters with stalled learning when the alarm was raised.
function stalled({ feeder, evidence: { learning = [] } }) {
  if (!learning.length) return "";
  const more = learning.length > LISTED ? ` and ${learning.length - LISTED} more` : "";
  return `. Meters: ${learning.slice(0, LISTED).map((m) => meterName(feeder, m.meter)).join(", ")}${more}`;
}

// An error of the feeder's files that explains the accusation as well.
function hint({ data_error: error }) {
  return error ? el("p", { class: "hint", text: error.text }) : null;
}

export class Alarms {
  constructor({ onPick, onLink, onChange = () => {} }) {
    this.alarms = new Map();
    this.items = new Map();
    this.logs = new Map(); // Events of the alarms with an open log.
    this.loading = 0;
    this.heard = new Map(); // Newest event of each alarm during a request: the list may be older.
    this.raised = 0; // Number of active alarms without an acknowledgement, loaded or not.
    this.soon = null;
    this.wanted = null; // Timer of a search.
    this.turn = 0;
    this.onPick = onPick;
    this.onLink = onLink;
    this.onChange = onChange; // Called after each change of an alarm.
    this.onList = () => {}; // Called after a list with names of customers.
    this.onLog = () => {}; // Called after a log was opened, loaded or closed.
    this.feeder = null;
    this.source = null;
    this.retry = null;
    this.problem = null; // Problem of the database: active alarms may be missing in the list.
    this.render = steady(byId("alarm-list"), () => this.draw());
    setInterval(() => this.check(), EVERY_MS);
    for (const id of ["alarm-state", "alarm-severity", "alarm-kind"]) byId(id).addEventListener("change", () => this.reload());
    byId("alarm-scope").addEventListener("change", () => this.reload());
    byId("alarm-text").addEventListener("input", () => this.search());
    byId("alarm-more").addEventListener("click", () => this.reload({ more: true }));
  }

  filters() {
    const state = { active: ["raised", "acknowledged"], raised: ["raised"], all: [] }[byId("alarm-state").value];
    const feeder = byId("alarm-scope").value === "this" ? this.feeder : null;
    return { state, severity: byId("alarm-severity").value, kind: byId("alarm-kind").value, feeder, text: byId("alarm-text").value.trim() };
  }

  // The service searches: several letters, or several events, cause one request.
  search() {
    this.wanted ??= setTimeout(() => { this.wanted = null; this.reload(); }, SOON_MS);
  }

  watch(feeder) {
    this.feeder = feeder;
    if (!this.source && this.retry === null) this.connect();
    else if (byId("alarm-scope").value === "this") this.reload();
  }

  async connect() {
    this.retry = null;
    this.heard.clear(); // The new stream starts at the end of the list.
    try {
      const after = await this.load();
      this.source?.close();
      this.source = new EventSource(`${API}/stream?after=${after}`);
      this.source.addEventListener("open", () => this.onLink(true));
      this.source.addEventListener("alarm", (event) => this.take(JSON.parse(event.data)));
      this.source.addEventListener("error", () => {
        this.onLink(false);
        if (this.source.readyState === EventSource.CLOSED) this.again();
      });
    } catch (error) {
      this.fail(error);
    }
  }

  async reload(options) {
    try {
      await this.load(options);
    } catch (error) {
      this.fail(error);
    }
  }

  fail(error) {
    byId("alarm-error").textContent = `Alarms not loaded: ${error.message}`;
    byId("alarm-error").hidden = false;
    this.render();
    this.onLink(false);
    this.again();
  }

  again() {
    this.source?.close();
    this.source = null;
    this.retry ??= setTimeout(() => this.connect(), 3000);
  }

  async load({ more = false } = {}) {
    const { state, ...others } = this.filters();
    const query = new URLSearchParams({ limit: PAGE });
    for (const value of state) query.append("state", value);
    for (const [name, value] of Object.entries(others)) if (value) query.set(name, value);
    if (more && this.next) query.set("cursor", this.next);
    this.turn += 1;
    const { turn } = this;
    this.loading += 1;
    try {
      const page = await getJson(`${API}?${query}`);
      if (turn === this.turn) this.list(page, more); // Otherwise the response belongs to an earlier choice.
      return page.last_event;
    } finally {
      this.loading -= 1;
      if (this.loading === 0) this.heard.clear();
    }
  }

  list(page, more) {
    byId("alarm-error").hidden = true;
    if (!more) this.alarms.clear();
    this.tell(page);
    for (const alarm of page.alarms) this.alarms.set(alarm.id, alarm);
    // Events that arrived before this response and are newer; the stream sends each once.
    for (const { seq, alarm } of this.heard.values()) if (seq > page.last_event) this.put(alarm);
    this.next = page.next;
    this.render();
    this.onList();
  }

  // Values that are not part of any event.
  async check() {
    if (!this.source) return;
    try {
      this.tell(await getJson(`${API}?limit=1`));
    } catch (error) {
      if (error.answered) this.tell({ problem: error.message });
    }
    this.render();
  }

  tell({ raised = this.raised, unstored, problem }) {
    this.raised = raised;
    this.problem = problem;
    const waiting = unstored ? `, ${unstored} change${unstored === 1 ? " waits" : "s wait"}` : "";
    byId("alarm-unstored").hidden = !problem;
    byId("alarm-unstored").textContent = problem ? `Alarms may be missing here${waiting}. ${problem}` : "";
  }

  take(event) {
    const { alarm } = event;
    this.onChange();
    if (this.loading > 0) this.heard.set(alarm.id, event);
    if (this.logs.has(alarm.id)) this.loadLog(alarm.id);
    this.put(alarm);
    this.render();
    this.soon ??= setTimeout(() => { this.soon = null; this.check(); }, SOON_MS);
  }

  // Alarms outside of the filters are not kept: the service has them.
  put(alarm) {
    if (!this.fits(alarm)) this.alarms.delete(alarm.id);
    else if (this.filters().text && !this.alarms.has(alarm.id)) this.search();
    else this.alarms.set(alarm.id, alarm);
  }

  fits(alarm) {
    const { state, severity, kind, feeder } = this.filters();
    return (!state.length || state.includes(alarm.state)) && (!severity || alarm.severity === severity) && (!kind || alarm.kind === kind) && (!feeder || alarm.feeder === feeder);
  }

  shown() {
    return [...this.alarms.values()].filter((a) => this.fits(a)).sort((a, b) => (a.id < b.id ? 1 : -1));
  }

  draw() {
    const list = this.shown();
    byId("alarm-count").hidden = this.raised === 0;
    byId("alarm-count").textContent = `${this.raised} new`;
    byId("alarm-none").hidden = list.length > 0 || !byId("alarm-error").hidden || this.problem !== null;
    byId("alarm-more").hidden = !this.next;
    const [focused, act] = [document.activeElement?.closest?.("[data-alarm]")?.dataset.alarm, document.activeElement?.dataset?.do];
    // Unchanged items keep their nodes: a click must not fall between two copies of a button.
    const before = this.items;
    this.items = new Map(list.map((alarm) => {
      const said = this.content(alarm);
      const old = before.get(alarm.id);
      return [alarm.id, old?.said === said ? old : { said, node: this.item(alarm) }];
    }));
    settle(byId("alarm-list"), [...this.items.values()].map(({ node }) => node));
    if (focused && document.activeElement === document.body) {
      const item = byId("alarm-list").querySelector(`[data-alarm="${CSS.escape(focused)}"]`);
      (item?.querySelector(`[data-do="${CSS.escape(act ?? "")}"]`) ?? item?.querySelector("button"))?.focus();
    }
  }

  item(alarm) {
    const e = alarm.evidence;
    const numbers = isKnown(e.v_volt_reported) && alarm.kind === "meter-manipulated"
      ? `${volt(e.v_volt_reported)} reported, ${volt(e.v_volt_estimated)} reconstructed (${signed(e.v_volt_reported - e.v_volt_estimated)} V${e.kind ? `, ${e.kind}` : ""})`
      : `${alarm.reason}${stalled(alarm)}`;
    const subject = subjectOf(alarm);
    const where = subject ? `${subject} · ${alarm.feeder}` : alarm.feeder;
    const since = alarm.state === "cleared"
      ? el("span", { class: "quiet", text: `${clock(alarm.t_raised)}, cleared after ${duration(alarm.t_cleared - alarm.t_raised)}` })
      : sinceNode(alarm.t_raised);
    const answered = alarm.acknowledged_by
      ? el("p", { class: "answer" }, `Acknowledged by ${alarm.acknowledged_by}`, alarm.comment ? el("q", { text: alarm.comment }) : null)
      : null;
    return el("li", { class: "alarm", "data-alarm": alarm.id, "data-severity": alarm.severity, "data-state": alarm.state },
      el("div", { class: "what" },
        el("p", { class: "name" },
          el("b", { text: KIND[alarm.kind] ?? alarm.kind }),
          el("span", { class: "severity", text: alarm.severity }),
          alarm.count > 1 ? el("span", { class: "times", title: "number of occurrences", text: `× ${alarm.count}` }) : null,
          guideLink(alarm.kind)),
        el("p", {}, el("a", { href: `#${encodeURIComponent(alarm.feeder)}`, class: "where", text: where, on: { click: (event) => {
          event.preventDefault();
          this.onPick(alarm.feeder, alarm.meter, alarm.customer);
        } } })),
        el("p", { class: "numbers", text: numbers }),
        alarm.kind === "meter-manipulated" ? hint(e) : null,
        el("p", { class: "since" }, since),
        answered,
        el("p", { class: "tools more" },
          this.answerButton(alarm),
          alarm.meter && this.onSeries ? this.button("series", "Time series", () => this.onSeries(alarm)) : null,
          this.button("comment", "Comment", () => this.ask("comment", alarm)),
          el("button", { type: "button", class: "plain", "data-do": "log", "aria-expanded": String(this.logs.has(alarm.id)), text: "Log", on: { click: () => this.toggleLog(alarm.id) } })),
        this.log(alarm.id)));
  }

  // Acknowledgement of an open alarm, or its withdrawal while the alarm is active.
  answerButton(alarm) {
    const made = (kind, name, text) => el("button", { type: "button", class: kind, "data-do": name, text, on: { click: () => this.ask(name, alarm) } });
    if (alarm.acknowledged_by === null) return made("ack", "ack", "Acknowledge");
    return alarm.state === "acknowledged" ? made("withdraw", "unack", "Withdraw") : null;
  }

  button(name, text, click) {
    return el("button", { type: "button", class: "plain", "data-do": name, text, on: { click } });
  }

  // ------------------------------------------------------------------ the log

  log(id) {
    if (!this.logs.has(id)) return null;
    const found = this.logs.get(id);
    if (found === null) return el("p", { class: "quiet", text: "Loading …" });
    if (found instanceof Error) return el("p", { class: "error", text: `Log not loaded: ${found.message}` });
    return el("ol", { class: "log", "aria-label": "Log of the alarm" }, ...found.filter(({ change }) => change !== "updated").map((event) => {
      const { t, change, comment } = event;
      const by = event.who ? ` by ${event.who}` : "";
      return el("li", {}, el("time", { text: clock(t) }), ` ${CHANGE[change] ?? change}${by}`, comment ? el("q", { text: comment }) : null);
    }));
  }

  async toggleLog(id) {
    if (this.logs.delete(id)) this.logged();
    else {
      this.logs.set(id, null);
      this.logged();
      await this.loadLog(id);
    }
  }

  async loadLog(id) {
    const found = await getJson(`${API}/${encodeURIComponent(id)}/events?limit=1000`).then(({ events }) => events, (error) => error);
    if (!this.logs.has(id)) return;
    this.logs.set(id, found);
    this.logged();
  }

  logged() {
    this.render();
    this.onLog();
  }

  // Content of an item, for the comparison with the drawn one.
  content(alarm) {
    const log = this.logs.get(alarm.id);
    return JSON.stringify([alarm, log instanceof Error ? log.message : log]);
  }

  // ------------------------------------------------------------------ actions

  ask(name, alarm) {
    ask({
      ...ACTIONS[name],
      what: `${KIND[alarm.kind] ?? alarm.kind}: ${subjectOf(alarm) || alarm.feeder}. ${alarm.reason}`,
      send: async (by, { text }) => {
        const more = name === "ack" ? { count: alarm.count } : {};
        this.put(await post(`${API}/${encodeURIComponent(alarm.id)}/${name}`, { ...by, comment: text, ...more }));
        if (this.logs.has(alarm.id)) this.loadLog(alarm.id);
        this.onChange();
        this.render();
      },
    });
  }
}
