// Incident list: one line per incident, expandable to its alarms and its log; actions of operators; hand-over.

import { ask, post } from "./actions.js";
import { byId, clock, duration, el, getJson, guideLink, isKnown, settle, sinceNode, steady } from "./dom.js";
import { BUSBAR, customerName, meterName } from "./names.js";
import { session } from "./session.js";

const API = "/api/v1";
const KIND = {
  manipulation: "Manipulation",
  "data-loss": "Data loss",
  "voltage-limit": "Voltage limit",
  undecided: "Undecided",
  "clock-offset": "Clock offset",
  "identity-mismatch": "Identity mismatch",
  "learning-stalled": "Learning stalled",
};
const CHANGE = {
  opened: "opened", extended: "further alarms", escalated: "higher severity", reopened: "opened again",
  updated: "alarms changed", cleared: "cleared", acknowledged: "acknowledged", unacknowledged: "acknowledgement withdrawn",
  assigned: "assigned", commented: "comment", shelved: "shelved", unshelved: "shelf ended",
  "work-begun": "planned work begun", "work-ended": "planned work ended",
};
const ACTIONS = {
  ack: { title: "Acknowledge incident", verb: "Acknowledge", key: "a" },
  unack: { title: "Withdraw acknowledgement", verb: "Withdraw", key: "u" },
  comment: { title: "Comment on incident", verb: "Add comment", key: "c", needed: true },
  assign: { title: "Assign incident", verb: "Assign", key: "g" },
  shelve: { title: "Shelve alarms", verb: "Shelve", key: "s", text: "Reason", needed: true },
  work: { title: "Planned work", verb: "Enter", text: "Reason", needed: true },
};
const HOURS = [1, 4, 8, 24, 72, 168];
const PAGE = 50;
const ALARMS_SHOWN = 100;
const METERS_LISTED = 20; // Largest number of meters in the choice of a shelf.
const EVERY_MS = 5000;
const SOON_MS = 200;

const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
// Devices of an incident: one by name, several by number.
function subject({ feeder, meters, customers }) {
  const own = meters.filter((meter) => meter !== BUSBAR);
  const busbar = own.length < meters.length;
  if (own.length) return `${own.length > 1 ? plural(own.length, "meter") : meterName(feeder, own[0])}${busbar ? " and the busbar meter" : ""}`;
  if (busbar) return meterName(feeder, BUSBAR);
  if (customers.length) return customers.length === 1 ? `inverter of ${customerName(feeder, customers[0])}` : plural(customers.length, "inverter");
  return null;
}

const answerable = ({ state, unacknowledged }) => state !== "cleared" && unacknowledged > 0;

// Sentence on an incident: the devices of a manipulation, otherwise the reason of its severest alarm.
function reasonOf({ feeder, kind, meters, customers, reason }) {
  const named = [...meters.map((meter) => meterName(feeder, meter)), ...customers.map((customer) => `inverter of ${customerName(feeder, customer)}`)];
  if (kind !== "manipulation" || !named.length) return reason;
  const more = named.length > METERS_LISTED ? ` and ${named.length - METERS_LISTED} more` : "";
  return named.length === 1 ? `${named[0]} ${reason}` : `Named as manipulated: ${named.slice(0, METERS_LISTED).join(", ")}${more}.`;
}

export class Incidents {
  constructor({ alarms, onPick }) {
    this.alarms = alarms;
    this.onPick = onPick;
    this.found = [];
    this.items = new Map();
    this.open = new Map(); // Alarms and events of expanded incidents.
    this.requests = new Map(); // Latest request for them that has not failed, with the incident of that time.
    this.chosen = new Set(); // Selected incidents.
    this.feeder = null;
    this.limit = PAGE;
    this.turn = 0;
    this.soon = null;
    this.most = 86400;
    for (const id of ["incident-state", "incident-kind", "incident-severity", "incident-since", "incident-scope", "incident-sort"]) byId(id).addEventListener("change", () => this.reload());
    byId("incident-text").addEventListener("input", () => this.later());
    byId("incident-more").addEventListener("click", () => { this.limit += PAGE; this.reload(); });
    byId("incident-list").addEventListener("keydown", (event) => this.key(event));
    byId("incident-chosen-ack").addEventListener("click", () => this.acknowledge());
    byId("incident-chosen-all").addEventListener("click", () => this.choose(this.found.filter(answerable)));
    byId("incident-chosen-none").addEventListener("click", () => this.choose([]));
    byId("shift-open").addEventListener("click", () => this.shift());
    byId("shift-close").addEventListener("click", () => byId("shift").close());
    byId("shift-since").addEventListener("change", () => this.shift());
    byId("work-open").addEventListener("click", () => this.ask("work"));
    this.render = steady(byId("incident-list"), () => this.draw());
    alarms.onLog = alarms.onList = () => this.render();
    setInterval(() => this.reload(), EVERY_MS);
  }

  watch(feeder) {
    this.feeder = feeder;
    this.reload();
  }

  // An alarm has changed: several events cause one request.
  later() {
    this.soon ??= setTimeout(() => { this.soon = null; this.reload(); }, SOON_MS);
  }

  query() {
    const query = new URLSearchParams({ limit: this.limit, sort: byId("incident-sort").value });
    const state = byId("incident-state").value;
    for (const value of { open: ["raised", "acknowledged"], todo: ["raised"], all: [] }[state]) query.append("state", value);
    if (state === "todo") for (const name of ["shelved", "planned"]) query.set(name, "false");
    for (const name of ["kind", "severity"]) if (byId(`incident-${name}`).value) query.set(name, byId(`incident-${name}`).value);
    const hours = Number(byId("incident-since").value);
    if (hours) query.set("since", Date.now() / 1000 - hours * 3600);
    if (byId("incident-scope").value === "this" && this.feeder) query.set("feeder", this.feeder);
    const text = byId("incident-text").value.trim();
    if (text) query.set("text", text);
    return query;
  }

  async reload() {
    if (!this.feeder) return;
    this.turn += 1;
    const { turn } = this;
    try {
      const page = await getJson(`${API}/incidents?${this.query()}`);
      if (turn !== this.turn) return; // The response belongs to an earlier choice.
      byId("incident-error").hidden = byId("incident-loading").hidden = true;
      byId("incident-count").hidden = page.raised === 0;
      byId("incident-count").textContent = `${page.raised} new`;
      byId("incident-more").hidden = page.next === null;
      await this.list(page.incidents);
    } catch (error) {
      if (turn !== this.turn) return;
      byId("incident-loading").hidden = true;
      byId("incident-error").textContent = `Incidents not loaded: ${error.message}`;
      byId("incident-error").hidden = false;
    }
  }

  async list(found) {
    this.found = found;
    await Promise.all(found.filter((one) => this.open.has(one.id) && this.requests.get(one.id)?.of !== JSON.stringify(one)).map((one) => this.details(one.id)));
    this.render();
  }

  async details(id) {
    const request = { of: JSON.stringify(this.found.find((one) => one.id === id)) };
    this.requests.set(id, request);
    try {
      const [{ alarms, next }, { events }] = await Promise.all([
        getJson(`${API}/alarms?${new URLSearchParams({ incident: id, limit: ALARMS_SHOWN, sort: "severity" })}`),
        getJson(`${API}/incidents/${id}/events?limit=1000`),
      ]);
      // The response to an earlier request may come after that to a later one.
      if (this.open.has(id) && this.requests.get(id) === request) this.open.set(id, { alarms, more: next !== null, events });
    } catch (error) {
      if (this.requests.get(id) === request) this.requests.delete(id);
      throw error;
    }
  }

  // Select incidents: ids of others are dropped.
  choose(incidents) {
    this.chosen = new Set(incidents.map(({ id }) => id));
    this.render();
  }

  mark(id) {
    if (!this.chosen.delete(id)) this.chosen.add(id);
    this.render();
  }

  // Acknowledge all selected incidents; those that the service refuses stay selected.
  acknowledge() {
    const chosen = this.found.filter(({ id }) => this.chosen.has(id));
    ask({
      ...ACTIONS.ack,
      title: `Acknowledge ${plural(chosen.length, "incident")}`,
      what: `${chosen.map((one) => `${KIND[one.kind] ?? one.kind}: ${one.feeder}`).join(", ")}.`,
      send: async (by, values) => {
        const refused = [];
        for (const one of chosen.filter(({ id }) => this.chosen.has(id))) {
          const [url, body] = request("ack", one, values);
          await post(url, { ...by, ...body }).then(() => this.chosen.delete(one.id), (error) => refused.push(`${one.feeder}: ${error.message}`));
        }
        await this.reload();
        if (refused.length) throw new Error(refused.join("; "));
        byId("incident-list").querySelector(".line")?.focus();
      },
    });
  }

  async toggle(id) {
    if (this.open.has(id)) {
      this.open.delete(id);
    } else {
      this.open.set(id, null);
      this.render();
      await this.details(id).catch((error) => this.open.set(id, { problem: error.message }));
    }
    this.render();
  }

  draw() {
    for (const id of this.chosen) if (!this.found.some((one) => one.id === id && answerable(one))) this.chosen.delete(id);
    byId("incident-chosen").hidden = this.chosen.size === 0;
    const text = `${this.chosen.size} selected`;
    if (byId("incident-chosen-count").textContent !== text) byId("incident-chosen-count").textContent = text;
    byId("incident-none").hidden = this.found.length > 0 || !byId("incident-error").hidden || !byId("incident-loading").hidden;
    byId("incident-none").textContent = byId("incident-state").value === "all" ? "No incidents." : "No open incidents. Choose “All, with cleared” for earlier ones.";
    const focused = document.activeElement?.closest?.("[data-incident]");
    const [own, act] = [focused?.dataset.incident, document.activeElement?.dataset?.act];
    // Unchanged items keep their nodes: a click must not fall between two copies of a button.
    const before = this.items;
    this.items = new Map(this.found.map((incident) => {
      const open = this.open.get(incident.id);
      const said = JSON.stringify([incident, this.chosen.has(incident.id), subject(incident), reasonOf(incident), open, (open?.alarms ?? []).map((alarm) => this.alarms.content(alarm))]);
      const old = before.get(incident.id);
      return [incident.id, old?.said === said ? old : { said, node: this.item(incident) }];
    }));
    settle(byId("incident-list"), [...this.items.values()].map(({ node }) => node));
    if (own && !byId("incident-list").contains(document.activeElement)) {
      const item = byId("incident-list").querySelector(`[data-incident="${CSS.escape(own)}"]`);
      (item?.querySelector(`[data-act="${CSS.escape(act ?? "")}"]`) ?? item?.querySelector(".line"))?.focus();
    }
  }

  item(incident) {
    const shown = this.open.has(incident.id);
    const about = subject(incident);
    const place = incident.feeder + (about ? ` · ${about}` : "");
    const numbers = incident.state === "cleared"
      ? `cleared after ${duration(incident.t_cleared - incident.t_first)}`
      : `${plural(incident.active, "alarm")}${incident.unacknowledged ? `, ${incident.unacknowledged} new` : ""}`;
    const note = (text, kind) => (text ? el("span", { class: "note", "data-kind": kind, text }) : null);
    const line = el("button", { type: "button", class: "line", "aria-expanded": String(shown), "aria-keyshortcuts": "a u c g s x", "data-act": "line", on: { click: () => this.toggle(incident.id) } },
      el("span", { class: "grade", text: incident.severity }),
      el("b", { text: KIND[incident.kind] ?? incident.kind }),
      el("span", { class: "place", text: place }),
      el("span", { class: "numbers", text: numbers }),
      sinceNode(incident.t_first),
      note(isKnown(incident.shelved_until) && incident.state !== "cleared" ? `shelved until ${clock(incident.shelved_until)}` : "", "shelved"),
      note(isKnown(incident.planned_until) && incident.state !== "cleared" ? `planned work until ${clock(incident.planned_until)}` : "", "work"),
      note(incident.state === "acknowledged" ? `acknowledged${incident.acknowledged_by ? ` by ${incident.acknowledged_by}` : ""}` : "", "ack"),
      note(incident.assigned_to ? `→ ${incident.assigned_to}` : "", "assigned"));
    const suppressed = isKnown(incident.shelved_until) || isKnown(incident.planned_until);
    return el("li", { class: "incident", "data-incident": incident.id, "data-severity": incident.severity, "data-state": incident.state, "data-suppressed": suppressed ? "yes" : "no" },
      answerable(incident) ? el("input", { type: "checkbox", class: "pick", "data-act": "pick", checked: this.chosen.has(incident.id), "aria-label": `Select ${KIND[incident.kind] ?? incident.kind}, ${place}`, on: { change: () => this.mark(incident.id) } }) : null,
      line, shown ? this.body(incident) : null);
  }

  body(incident) {
    const found = this.open.get(incident.id);
    const button = (name, text) => el("button", { type: "button", "data-act": name, title: `Key ${ACTIONS[name].key}`, text, on: { click: () => this.ask(name, incident) } });
    const open = incident.state !== "cleared";
    const buttons = el("div", { class: "tools" },
      open && incident.unacknowledged ? button("ack", "Acknowledge all") : null,
      open && incident.active > incident.unacknowledged ? button("unack", "Withdraw") : null,
      button("comment", "Comment"), button("assign", "Assign"),
      open ? button("shelve", "Shelve") : null,
      guideLink(incident.kind));
    const events = (found?.events ?? []).filter((event) => event.change !== "updated");
    return el("div", { class: "body" },
      el("p", { class: "reason", text: reasonOf(incident) }),
      el("p", {}, el("a", { href: `#${encodeURIComponent(incident.feeder)}`, class: "where", text: `Show ${incident.feeder}`, on: { click: (event) => {
        event.preventDefault();
        this.onPick(incident.feeder, incident.meters[0] ?? null, incident.customers[0] ?? null);
      } } })),
      buttons,
      found === null ? el("p", { class: "quiet", text: "Loading …" }) : null,
      found?.problem ? el("p", { class: "error", text: `Not loaded: ${found.problem}` }) : null,
      el("ol", { class: "alarm-list", "aria-label": "Alarms of the incident" }, ...(found?.alarms ?? []).map((alarm) => this.alarms.item(alarm))),
      found?.more ? el("p", { class: "quiet", text: `${incident.alarms - ALARMS_SHOWN} more alarms` }) : null,
      events.length ? el("ol", { class: "log", "aria-label": "Log of the incident" }, ...events.map((event) => this.logged(event))) : null);
  }

  logged(event) {
    const { t, change, comment, incident } = event;
    const to = change === "assigned" ? ` to ${incident.assigned_to ?? "none"}` : "";
    const by = event.who ? ` by ${event.who}` : "";
    return el("li", {}, el("time", { text: clock(t) }), ` ${CHANGE[change] ?? change}${to}${by}`, comment ? el("q", { text: comment }) : null);
  }

  // Arrow keys go from incident to incident, letters act on the focused one.
  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const own = event.target.closest("[data-incident]");
    const lines = [...byId("incident-list").querySelectorAll(".line")];
    const place = lines.findIndex((line) => own?.contains(line));
    if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      lines[place + (event.key === "ArrowDown" ? 1 : -1)]?.focus();
      event.preventDefault();
      return;
    }
    const incident = this.found.find((one) => one.id === own?.dataset.incident);
    if (event.key.toLowerCase() === "x" && incident && answerable(incident)) {
      event.preventDefault();
      this.mark(incident.id);
      return;
    }
    const name = Object.keys(ACTIONS).find((each) => ACTIONS[each].key === event.key.toLowerCase());
    if (!incident || !name || (incident.state === "cleared" && !["comment", "assign"].includes(name))) return;
    if (name === "ack" && !incident.unacknowledged) return;
    if (name === "unack" && incident.active === incident.unacknowledged) return;
    event.preventDefault();
    this.ask(name, incident);
  }

  // ---------------------------------------------------------------- actions

  async ask(name, incident = null) {
    const action = ACTIONS[name];
    const about = incident && subject(incident);
    const now = Date.now() / 1000;
    const { feeder } = this;
    ask({
      ...action,
      what: incident
        ? `${KIND[incident.kind] ?? incident.kind}: ${incident.feeder}${about ? ` · ${about}` : ""}, ${plural(incident.active, "active alarm")}.`
        : `Alarms of ${feeder} are recorded, marked, and do not notify.`,
      to: name === "assign" ? incident.assigned_to ?? "" : undefined,
      scope: name === "shelve" ? scopes(incident) : undefined,
      duration: name === "shelve" ? await this.durations() : undefined,
      times: name === "work" ? [now, now + 7200] : undefined,
      send: async (by, values) => {
        const [url, body] = request(name, incident ?? { feeder }, values);
        await post(url, { ...by, ...body });
        this.reload();
        if (byId("shift").open) this.shift();
      },
    });
  }

  // Choice of durations up to the service's limit.
  async durations() {
    const { max_duration_s: most } = await getJson(`${API}/shelves`).catch(() => ({ max_duration_s: this.most }));
    this.most = most;
    const hours = HOURS.filter((each) => each * 3600 <= most);
    return hours.length ? hours.map((each) => [each * 3600, plural(each, "hour")]) : [[most, duration(most)]];
  }

  // -------------------------------------------------------------- hand-over

  async shift() {
    const since = Date.now() / 1000 - Number(byId("shift-since").value) * 3600;
    byId("shift-error").hidden = true;
    try {
      const found = await getJson(`${API}/hand-over?since=${since}`);
      const rows = (id, list, row) => byId(id).replaceChildren(...(list.length ? list.map(row) : [el("li", { class: "quiet", text: "None." })]));
      byId("shift-time").textContent = `at ${clock(found.t, { day: true })}`;
      rows("shift-incidents", found.incidents, (one) => this.summary(one));
      rows("shift-shelves", found.shelves, (one) => el("li", {},
        el("span", {}, el("b", { text: shelved(one) }), ` until ${clock(one.until)}, ${one.who}: `, el("q", { text: one.reason })),
        this.ending(`${API}/shelves/${one.id}/end`)));
      rows("shift-works", found.planned_work, (one) => el("li", {},
        el("span", {}, el("b", { text: one.feeder }), ` ${clock(one.t_from)} to ${clock(one.t_until)}, ${one.who}: `, el("q", { text: one.reason })),
        this.ending(`${API}/planned-work/${one.id}/end`)));
      rows("shift-comments", found.comments, (one) => el("li", {},
        el("span", {}, el("time", { text: clock(one.t) }), ` ${one.feeder}, ${one.who}, ${CHANGE[one.change] ?? one.change}: `, el("q", { text: one.comment }))));
    } catch (error) {
      byId("shift-error").textContent = `Not loaded: ${error.message}`;
      byId("shift-error").hidden = false;
    }
    if (!byId("shift").open) byId("shift").showModal();
  }

  summary(one) {
    const about = subject(one);
    const notes = [
      one.unacknowledged ? `${one.unacknowledged} new` : "acknowledged",
      isKnown(one.shelved_until) ? `shelved until ${clock(one.shelved_until)}` : null,
      isKnown(one.planned_until) ? `planned work until ${clock(one.planned_until)}` : null,
      one.assigned_to ? `assigned to ${one.assigned_to}` : null,
    ].filter(Boolean).join(", ");
    return el("li", { "data-severity": one.severity }, el("span", {},
      el("b", { text: `${KIND[one.kind] ?? one.kind}, ${one.severity}` }),
      ` ${one.feeder}${about ? ` · ${about}` : ""}, ${plural(one.active, "alarm")}, ${notes}, since ${clock(one.t_first)}`));
  }

  ending(url) {
    return el("button", { type: "button", class: "plain", text: "End", on: { click: async () => {
      try {
        const name = localStorage.getItem("gridsec.who") ?? "";
        await post(url, session.name === null ? { "who": name } : {});
        await this.shift();
        this.reload();
      } catch (error) {
        byId("shift-error").textContent = `Not ended: ${error.message}`;
        byId("shift-error").hidden = false;
      }
    } } });
  }
}

// Alarms of a shelf.
function shelved(one) {
  const what = one.alarm ? "one alarm" : one.incident ? "one incident" : [one.meter && meterName(one.feeder, one.meter), one.kind].filter(Boolean).join(", ");
  return `${one.feeder}: ${what}`;
}

// Alarms that a shelf may cover: those of the incident, of one of its meters, of one of its kinds.
function scopes({ id, feeder, meters, kinds }) {
  const own = [["this incident", { incident: id }]];
  for (const meter of meters.slice(0, METERS_LISTED)) own.push([`all of ${meterName(feeder, meter)}`, { feeder, meter }]);
  for (const kind of kinds) own.push([`all ${kind} of ${feeder}`, { feeder, kind }]);
  return own.map(([text, value]) => [JSON.stringify(value), text]);
}

// Address and body of an action.
function request(name, { id, feeder, count }, { text, to, scope, duration: seconds, from, until }) {
  if (name === "shelve") return [`${API}/shelves`, { ...JSON.parse(scope), duration_s: seconds, reason: text }];
  if (name === "work") return [`${API}/planned-work`, { feeder, t_from: from, t_until: until, reason: text }];
  const more = { ack: { count }, assign: { to } }[name];
  return [`${API}/incidents/${id}/${name}`, { comment: text, ...more }];
}
