// Assembly of the page: selection of the feeder, its live states, and the freshness of the data.

import { Alarms } from "./alarms.js";
import { Incidents } from "./incidents.js";
import { Commissioning } from "./commissioning.js";
import { showDetail } from "./detail.js";
import { Diagram } from "./diagram.js";
import { APART, ages, bare, busbarWords, byId, clock, duration, el, getJson, isKnown, signed, status } from "./dom.js";
import { Fleet } from "./fleet.js";
import { session } from "./session.js";
import { Banner, offline } from "./banner.js";
import { meterName, rememberLayout } from "./names.js";
import { Series } from "./series.js";

const API = "/api/v1/feeders";
const KEPT = 600;

const page = { feeder: null, report: null, refused: null, code: null, selected: null, source: null, retry: null, heard: null, word: "…", others: 0, linked: true, alarmsLinked: true, past: new Map(), turn: 0 };
const diagram = new Diagram({ onSelect: (id) => select(id === page.selected ? null : id) });
const pick = async (feeder, meter, owner) => {
  if (feeder !== page.feeder?.name) await show(feeder);
  if (feeder !== page.feeder?.name) return;
  const customer = page.feeder?.layout.customers.find((c) => (owner ? c.customer === owner : c.meter === meter));
  if (customer) bring(customer.customer);
};
const alarms = new Alarms({
  onPick: pick,
  onLink: (up) => { page.alarmsLinked = up; },
  onChange: () => { incidents.later(); fleet.hint(); },
});
const incidents = new Incidents({ alarms, onPick: pick });

const fleet = new Fleet({ onPick: (name) => show(name), onChange: (attacked) => { page.others = attacked; title(); } });
const series = new Series({ onChange: () => address() });
const banner = new Banner({ onSelect: (id) => bring(id), onSeries: (meters) => series.open(meters) });
const commissioning = new Commissioning({ onChange: () => detail() });

alarms.onSeries = async (alarm) => {
  if (alarm.feeder !== page.feeder?.name) await show(alarm.feeder);
  if (alarm.feeder !== page.feeder?.name) return;
  series.open([alarm.meter], around(alarm));
};

// Address of the page: the feeder, and the shown time series.
function address(name = page.feeder?.name) {
  const query = series.query();
  if (name) history.replaceState(null, "", `#${encodeURIComponent(name)}${query ? `?${query}` : ""}`);
}

function wanted() {
  const [name, query = ""] = location.hash.slice(1).split("?");
  return { name: decodeURIComponent(name), query: new URLSearchParams(query) };
}

// Time around an alarm: half an hour before it, and half an hour after its end unless it is active.
function around(alarm) {
  const until = alarm.state === "cleared" ? alarm.t_cleared + 1800 : null;
  return { since: alarm.t_raised - 1800, until };
}

// ---------------------------------------------------------------- the feeder

async function start() {
  await session.begin();
  const { name, query } = wanted();
  let feeders;
  try {
    feeders = await fleet.first(name);
  } catch {
    page.linked = false;
    setTimeout(start, 3000);
    return;
  }
  if (!feeders.length) {
    banner.empty("The service monitors no feeder yet.");
    byId("next").hidden = true;
    setTimeout(start, 5000);
    return;
  }
  fleet.begin();
  const known = fleet.beside.has(name);
  await show(known ? name : feeders[0].name, known ? query : undefined);
}

async function show(name, query = new URLSearchParams()) {
  clearTimeout(page.retry);
  page.source?.close();
  page.turn += 1;
  const { turn } = page;
  const found = await getJson(`${API}/${encodeURIComponent(name)}`).catch((error) => error);
  if (turn !== page.turn) return; // The response belongs to an earlier choice.
  if (found instanceof Error) {
    if (found.status === 401) await session.begin();
    else if (found.answered) refused(name, found);
    else page.linked = false;
    page.retry = setTimeout(() => show(name, query), 3000);
    return;
  }
  const again = page.feeder?.name === name; // Connected again, or other tables: the series stays.
  page.feeder = found;
  rememberLayout(found);
  page.refused = null;
  page.report = null;
  page.heard = null;
  page.past = new Map();
  page.opened = performance.now();
  fleet.select(name);
  series.watch(found, again && series.query() ? new URLSearchParams(series.query()) : query);
  address(name);
  byId("meters").replaceChildren();
  select(null);
  diagram.show(page.feeder);
  verdict();
  alarms.watch(name);
  incidents.watch(name);
  commissioning.watch(name);
  listen(name);
}

// The service responds with the reason why this feeder is not monitored.
function refused(name, { message, code }) {
  Object.assign(page, { feeder: null, report: null, heard: null, past: new Map(), refused: message, code, linked: true });
  fleet.select(name);
  series.watch(null);
  address(name);
  byId("meters").replaceChildren();
  select(null);
  diagram.clear();
  verdict();
  fresh();
  alarms.watch(name);
  incidents.watch(name);
  commissioning.watch(null);
}

function listen(name) {
  page.source = new EventSource(`${API}/${encodeURIComponent(name)}/stream`);
  page.source.addEventListener("open", () => { page.linked = true; });
  page.source.addEventListener("state", (event) => take(JSON.parse(event.data)));
  page.source.addEventListener("error", () => {
    page.linked = false;
    fresh();
    if (page.source.readyState === EventSource.CLOSED) page.retry = setTimeout(() => show(name), 3000);
  });
}

function take(report) {
  if (report.feeder !== page.feeder?.name) return;
  if (report.revision !== page.feeder.revision) {
    show(report.feeder); // The drawn meters may belong to other customers now.
    return;
  }
  // By the service's clock; a repeated state keeps its age.
  const made = performance.now() - 1000 * report.age_s;
  const again = page.report?.t === report.t;
  page.heard = again ? Math.min(page.heard, made) : made;
  page.report = report;
  page.linked = true;
  for (const meter of again ? [] : report.meters) {
    const past = page.past.get(meter.meter) ?? [];
    past.push(point(report.t, meter));
    if (past.length > KEPT) past.shift();
    page.past.set(meter.meter, past);
  }
  fleet.hint();
  diagram.update(report);
  series.take(report);
  verdict();
  fresh();
  detail();
  table();
}

const point = (t, m) => ({
  t,
  reported: m.v_volt_reported,
  estimated: m.model_only ? null : m.v_volt_estimated,
  half: !m.model_only && isKnown(m.v_volt_std) ? 3 * m.v_volt_std : null,
});

// --------------------------------------------------------------- the verdict

function verdict() {
  const { report, feeder } = page;
  byId("busbar-meter").hidden = !report?.busbar?.suspect;
  byId("busbar-meter").textContent = report?.busbar?.suspect ? busbarWords(report.busbar) : "";
  if (!report) {
    banner.place(feeder ?? { name: wanted().name });
    banner.empty(page.refused ?? "Waiting for the first tick.", page.refused ? page.code : null);
    title(page.refused ? APART[page.code] ?? "NOT MONITORED" : "NO DATA");
    return;
  }
  const several = diagram.level === null;
  const real = report.meters.filter((m) => !m.model_only).map((m) => (several ? m.v2_pu_estimated : m.v_volt_estimated)).filter(isKnown);
  const [low, high] = [Math.min(...real), Math.max(...real)].map((v) => (several ? Math.sqrt(v).toFixed(3) : bare(v)));
  title(banner.show(report, feeder, real.length ? `${low} – ${high} ${several ? "pu" : "V"}` : "–"));
}

// ------------------------------------------------------------- the freshness

// Title of the tab: attacked feeders besides the shown one come first.
function title(word = page.word) {
  page.word = word;
  fleet.mark(word);
  const others = page.others ? `${page.others} ATTACKED | ` : "";
  document.title = `${others}${word} – ${page.feeder?.title || page.feeder?.name || ""} – gridsec`;
}

// Time since which no value uses a reading.
function unmeasured(report) {
  return isKnown(report.t_measured) ? `no data since ${clock(report.t_measured)}` : "no data yet";
}

function fresh() {
  const age = page.heard === null ? null : (performance.now() - page.heard) / 1000;
  const waiting = page.report === null;
  const apart = APART[(page.report?.displayed ?? page.report)?.cause];
  const stale = age !== null && age > ((apart && page.feeder.patience_shed_s) || page.feeder.patience_s);
  const state = !page.linked ? "lost" : stale ? "stale" : page.refused ? "refused" : waiting ? "connecting" : page.report.model_only ? (apart ? "apart" : "nodata") : "live";
  const shown = state === "live" && !page.alarmsLinked ? "alarms" : state;
  const words = {
    live: "live",
    connecting: "waiting for data …",
    refused: "not monitored",
    alarms: "connection lost for alarms",
    lost: age === null ? "connection lost" : `connection lost, data ${duration(age)} old`,
    stale: `data stale, ${duration(age ?? 0)} old`,
    apart: "not evaluated",
    nodata: waiting ? "" : unmeasured(page.report),
  };
  byId("link").dataset.state = shown;
  byId("link").lastElementChild.textContent = words[shown];
  // A feeder that is not monitored does not make the alarms of others stale.
  byId("main").dataset.alarms = page.alarmsLinked && state !== "lost" && state !== "stale" ? "yes" : "no";
  const believable = state === "live";
  offline(state, page.report, age);
  byId("main").dataset.fresh = believable ? "yes" : "no";
  byId("main").dataset.state = state;
  if (page.report) ages(page.report.t + (age ?? 0));
  if (state === "nodata") {
    // The model continues without readings; its voltages must not look like measured ones.
    const { t, t_measured: last } = page.report;
    banner.old("NO DATA", `${words.nodata.replace("n", "N")}${isKnown(last) ? ` (${duration(t - last)})` : ""}. The voltages are those of the model alone. ${page.report.reason}`, "nodata");
    title("NO DATA");
  } else if (!believable && !waiting && state !== "apart") {
    // An old verdict must not look like a verdict.
    const last = page.report.displayed ?? page.report;
    banner.old("NO LIVE DATA", `No data for ${duration(age)}. Last verdict, at ${clock(page.report.t)}: ${last.verdict}.`, "stale");
    title("NO LIVE DATA");
  } else if (!waiting && byId("verdict").dataset.verdict === "none") {
    verdict();
  }
}

// ------------------------------------------------------------- one customer

// Select a customer, and where the drawing stands below the alarms scroll to it.
function bring(id) {
  select(id);
  if (id !== null && matchMedia("(max-width: 980px)").matches) byId("diagram").scrollIntoView({ block: "center" });
}

function select(id) {
  page.selected = id;
  diagram.select(id);
  byId("detail-card").hidden = id === null || !page.report;
  if (id === null) return;
  detail();
  const { meter } = page.feeder.layout.customers.find((c) => c.customer === id);
  if (meter && page.report) recall(page.feeder.name, meter);
}

async function recall(feeder, meter) {
  const { past } = page;
  const [until, since] = [past.get(meter)?.[0]?.t ?? page.report.t, page.report.t - 3600];
  const room = KEPT - (past.get(meter)?.length ?? 0);
  if (room <= 0 || until <= since) return;
  const query = new URLSearchParams({ meter, since, until, limit: room });
  const found = await getJson(`${API}/${encodeURIComponent(feeder)}/history?${query}`).catch(() => ({ points: [] }));
  if (page.past !== past) return; // Another feeder is shown now.
  const old = found.points.filter((p) => p.meter).map((p) => point(p.t, p.meter));
  const later = (past.get(meter) ?? []).filter((p) => p.t >= until);
  past.set(meter, [...old, ...later].slice(-KEPT));
  detail();
}

function detail() {
  if (page.selected === null || !page.report) return;
  byId("detail-card").hidden = false;
  const customer = page.feeder.layout.customers.find((c) => c.customer === page.selected);
  const meter = page.report.meters.find((m) => m.meter === customer.meter);
  const mine = (item) => item.customer === customer.customer;
  const known = page.report.customers?.find(mine);
  const inverter = page.report.inverters?.find(mine);
  const alone = diagram.alone(customer);
  const now = { meter, inverter, alone, v: diagram.voltAt(customer), std: known?.v_volt_std ?? meter?.v_volt_std };
  const own = commissioning.of(customer.meter);
  byId("replaced").hidden = own === null;
  byId("detail-series").hidden = !customer.meter;
  showDetail(page.feeder, customer, { ...now, own, report: page.report }, page.past.get(customer.meter) ?? []);
}

// ------------------------------------------------------------- all meters

function table() {
  if (!byId("meters-box").open || !page.report) return;
  const limits = { low: page.feeder.v_min_volt, high: page.feeder.v_max_volt };
  const customer = new Map(page.feeder.layout.customers.map((c) => [c.meter, c.customer]));
  const ratio = (m) => m.score / m.threshold;
  const rank = (m) => (m.suspect ? 1e9 : 0) + (m.seen ? ratio(m) || 0 : 1e6);
  const busbar = page.report.busbar?.judged || page.report.busbar?.suspect ? [page.report.busbar] : [];
  const rows = [...page.report.meters, ...busbar].sort((a, b) => rank(b) - rank(a)).map((m) => {
    const now = status(m, limits, page.report);
    return el("tr", { "data-status": now.key },
      el("th", { scope: "row" }, customer.has(m.meter)
        ? el("button", { type: "button", class: "plain", text: meterName(page.feeder.name, m.meter), on: { click: () => select(customer.get(m.meter)) } })
        : el("span", { text: meterName(page.feeder.name, m.meter) })),
      el("td", { class: "num", text: bare(m.v_volt_reported) }),
      el("td", { class: "num", text: m.model_only && isKnown(m.v_volt_estimated) ? `model ${bare(m.v_volt_estimated)}` : bare(m.v_volt_estimated) }),
      el("td", { class: "num", text: signed(!m.model_only && isKnown(m.v_volt_reported) && isKnown(m.v_volt_estimated) ? m.v_volt_reported - m.v_volt_estimated : null) }),
      el("td", { class: "num", text: bare(isKnown(m.score) ? ratio(m) : null, 2) }),
      el("td", {}, el("span", { class: "state", "data-status": now.key, text: now.text })));
  });
  byId("meters").replaceChildren(...rows);
}

byId("detail-series").addEventListener("click", () => {
  const { meter } = page.feeder.layout.customers.find((c) => c.customer === page.selected);
  series.open([meter]);
});
byId("unselect").addEventListener("click", () => select(null));
byId("replaced").addEventListener("click", () => {
  const { meter, customer } = page.feeder.layout.customers.find((c) => c.customer === page.selected);
  commissioning.ask(meter, customer);
});
byId("meters-box").addEventListener("toggle", table);
addEventListener("hashchange", () => {
  const { name, query } = wanted();
  if (name && name !== page.feeder?.name) show(name, query);
  else if (page.feeder) series.restore(query);
});
setInterval(fresh, 500);
start();
