// All feeders, the worst first: verdict, its duration, suspects, silent meters, alarms. Shown with two feeders or
// more. The service sorts and filters; the page loads and draws the rows that are visible, whatever their number.

import { APART, byId, duration, el, getJson, isKnown, settle } from "./dom.js";
import { session } from "./session.js";

const API = "/api/v1/feeders";
const EVERY_MS = 500; // Between two requests of the numbers by verdict.
const LIST_MS = 2000; // Between two requests of the list while these numbers stay.
const SHARE = 5; // A request takes at most this part of the time between two of them.
const HEAD = 50; // Feeders in the selector.
const PAGE = 80; // Rows that are loaded around the visible ones.
const AROUND = 8; // Rows that are drawn above and below the visible ones.
const NARROW = matchMedia("(max-width: 620px)");
const shortest = () => (NARROW.matches ? 5 : 8); // Rows of the short list.
const rowHeight = () => (NARROW.matches ? 46 : 33); // Height of a row, px, as in the style sheet.
const WORDS = { attacked: "ATTACKED", undecided: "UNDECIDED", "no-data": "NO DATA", "not-monitored": "NOT MONITORED", clean: "CLEAN" };

const titleOf = (feeder) => feeder.title || feeder.name;
const stateOf = (feeder) => (APART[feeder.cause] && feeder.status === "undecided" ? "apart" : feeder.status);
const wordOf = (feeder) => (stateOf(feeder) === "apart" ? APART[feeder.cause] : WORDS[feeder.status]);

// Duration of the displayed verdict, or the time since the newest trusted reading.
function lasting(feeder) {
  const { t, age_s: age, t_measured: measured, status } = feeder;
  if (!isKnown(t)) return "";
  if (status === "no-data") return isKnown(measured) ? duration(t - measured + (age ?? 0)) : "";
  const begun = feeder.displayed_since ?? feeder.since;
  return isKnown(begun) && status === (feeder.displayed_verdict ?? feeder.verdict) ? duration(t - begun) : "";
}

export class Fleet {
  constructor({ onPick, onChange }) {
    this.onPick = onPick;
    this.onChange = onChange; // Called with the number of attacked feeders besides the shown one.
    this.head = []; // The worst feeders.
    this.beside = new Map(); // Latest entry of every feeder that was loaded last.
    this.counts = {};
    this.causes = {}; // Numbers of feeders that are not evaluated, by cause.
    this.size = this.total = 0; // Number of feeders, and of those that fit the filters.
    this.rows = { offset: 0, feeders: [] }; // Loaded part of the long list.
    this.states = new Set();
    this.selected = null;
    this.word = null;
    this.nodes = new Map();
    this.turn = 0;
    this.timer = null;
    this.due = Infinity; // Time of the next request, ms.
    this.listed = 0; // Time of the latest request of the list, ms.
    this.goal = null; // Row that gets the focus as soon as it is drawn.
    document.addEventListener("visibilitychange", () => { if (document.visibilityState !== "hidden" && this.timer) this.run(); });
    byId("fleet-all").addEventListener("toggle", () => this.refresh());
    byId("fleet-filter").addEventListener("input", () => this.search());
    byId("fleet-scroll").addEventListener("scroll", () => this.scrolled());
    byId("fleet-rows").addEventListener("keydown", (event) => this.key(event));
    byId("feeder").addEventListener("change", (event) => onPick(event.target.value));
  }

  // Load the worst feeders, and a wanted one in any case.
  async first(wanted) {
    this.selected = wanted || null;
    this.take(await getJson(this.query({ limit: HEAD })));
    return this.head;
  }

  begin() {
    this.wait(EVERY_MS);
  }

  wait(time) {
    clearTimeout(this.timer);
    this.due = performance.now() + time;
    this.timer = setTimeout(() => this.run(), time);
  }

  async run() {
    clearTimeout(this.timer);
    this.due = Infinity;
    this.wait(await this.update());
  }

  // An event of a stream: browsers delay the timers of hidden tabs by up to a minute.
  hint() {
    if (performance.now() >= this.due) this.run();
  }

  query(parameters) {
    const query = new URLSearchParams({ order: "worst", ...parameters });
    if (/^[A-Za-z0-9_-]{1,64}$/.test(this.selected ?? "")) query.set("include", this.selected);
    return `${API}?${query}`;
  }

  get long() {
    return byId("fleet-all").open;
  }

  /* Returns the time until the next request, ms. The numbers by verdict and the shown feeder come first; the list
     follows if a number has changed or `LIST_MS` have passed. A hidden tab needs the numbers alone, for its title. */
  async update({ list = false } = {}) {
    const begun = performance.now();
    try {
      const changed = this.count(await getJson(this.query({ limit: 0, order: "given" })));
      if (list || ((changed || begun - this.listed >= LIST_MS) && document.visibilityState !== "hidden")) {
        this.take(await getJson(this.query({ limit: HEAD })));
        if (this.long) await this.load();
      }
      byId("fleet").dataset.fresh = "yes";
    } catch (error) {
      byId("fleet").dataset.fresh = "no";
      if (error.status === 401) await session.begin();
    }
    return Math.max(EVERY_MS, SHARE * (performance.now() - begun));
  }

  // Numbers by verdict, and the shown feeder. Returns true if a number differs from the drawn one.
  count({ feeders, counts, causes = {} }) {
    const before = JSON.stringify([this.counts, this.causes, this.size]);
    const size = Object.values(counts).reduce((sum, each) => sum + each, 0);
    Object.assign(this, { counts, causes, size });
    for (const feeder of feeders) this.beside.set(feeder.name, feeder);
    const found = new Map(feeders.map((feeder) => [feeder.name, feeder]));
    const newer = (feeder) => found.get(feeder.name) ?? feeder;
    this.head = this.head.map(newer);
    this.rows = { ...this.rows, feeders: this.rows.feeders.map(newer) };
    this.render();
    return before !== JSON.stringify([counts, causes, size]);
  }

  take({ feeders, counts, causes = {}, total }) {
    Object.assign(this, { counts, causes, size: total, listed: performance.now() });
    this.head = feeders.slice(0, Math.min(HEAD, total));
    this.keep(feeders);
    this.render();
  }

  keep(feeders) {
    this.beside = new Map(feeders.map((feeder) => [feeder.name, feeder]));
  }

  // Part of the long list around the visible rows.
  async load() {
    this.turn += 1;
    const { turn } = this;
    const offset = Math.max(0, Math.floor(byId("fleet-scroll").scrollTop / rowHeight()) - PAGE / 4);
    const query = new URL(this.query({ offset, limit: PAGE }), location.href);
    const text = byId("fleet-filter").value.trim();
    if (text) query.searchParams.set("text", text);
    for (const state of this.states) query.searchParams.append("status", state);
    const { feeders, total } = await getJson(query);
    if (turn !== this.turn) return; // The response belongs to an earlier place or filter.
    this.total = total;
    this.rows = { offset, feeders: feeders.slice(0, Math.min(PAGE, Math.max(0, total - offset))) };
    this.render();
  }

  // A filter has changed, or the list was opened or closed.
  async refresh() {
    this.rows = { offset: 0, feeders: [] };
    byId("fleet-scroll").scrollTop = 0;
    if (this.long) await this.load().catch(() => { byId("fleet").dataset.fresh = "no"; });
    this.render();
  }

  filter(state) {
    if (!this.states.delete(state)) this.states.add(state);
    this.search();
  }

  // The short list ends with the first filter.
  search() {
    if (this.long) this.refresh();
    else byId("fleet-all").open = true;
  }

  scrolled() {
    if (!this.long) return;
    this.render();
    const [first, last] = this.window();
    const { offset, feeders } = this.rows;
    if (first < offset || Math.min(last, this.total) > offset + feeders.length) this.load().catch(() => {});
  }

  // First and last drawn row of the long list.
  window() {
    const box = byId("fleet-scroll");
    const first = Math.floor(box.scrollTop / rowHeight()) - AROUND;
    return [Math.max(0, first), Math.min(this.total, first + 2 * AROUND + Math.ceil(box.clientHeight / rowHeight()) + 1)];
  }

  select(name) {
    this.selected = name;
    const found = this.beside.get(name) ?? this.rows.feeders.find((feeder) => feeder.name === name);
    if (found) this.beside.set(name, found);
    else this.update({ list: true });
    this.render();
  }

  // Verdict of the shown feeder as in the title of the tab; newer than the list.
  mark(word) {
    this.word = word === "…" ? null : word;
    if (this.word === null) return;
    const option = [...byId("feeder").options].find((each) => each.value === this.selected);
    const text = option && `${word} – ${option.dataset.title}`;
    if (option && option.textContent !== text) option.textContent = text;
  }

  render() {
    const several = this.size > 1;
    byId("fleet").hidden = !several;
    const own = this.beside.get(this.selected)?.status === "attacked" ? 1 : 0;
    this.onChange(Math.max(0, (this.counts.attacked ?? 0) - own));
    this.selector();
    if (!several) return;
    this.tally();
    const [first, last] = this.long ? this.window() : [0, Math.min(shortest(), this.head.length)];
    const { offset, feeders } = this.long ? this.rows : { offset: 0, feeders: this.head };
    const shown = feeders.slice(Math.max(0, first - offset), Math.max(0, last - offset));
    const start = Math.max(first, offset);
    const open = this.long;
    byId("fleet-more").textContent = open
      ? `${this.total} of ${this.size}` : this.size > shortest() ? `${this.size - shortest()} further feeders` : "";
    const before = this.nodes;
    this.nodes = new Map(shown.map((feeder, k) => {
      const said = JSON.stringify([this.cells(feeder), feeder.name === this.selected, start + k]);
      const old = before.get(feeder.name);
      return [feeder.name, old?.said === said ? old : { said, node: this.row(feeder, start + k) }];
    }));
    byId("fleet-table").setAttribute("aria-rowcount", String((open ? this.total : this.size) + 1));
    const gap = (rows, key) => {
      const node = this[key] ??= el("tr", { class: "gap", "aria-hidden": true }, el("td", { colspan: 7 }));
      node.firstChild.style.height = `${rows * rowHeight()}px`;
      return rows > 0 ? [node] : [];
    };
    const focused = document.activeElement?.closest?.("#fleet-rows tr")?.dataset.feeder;
    settle(byId("fleet-rows"), [
      ...gap(open ? start : 0, "above"), ...[...this.nodes.values()].map(({ node }) => node),
      ...gap(open ? this.total - start - shown.length : 0, "below"),
    ]);
    if (focused && document.activeElement === document.body) this.nodes.get(focused)?.node.querySelector("button").focus();
    const goal = this.goal === null ? null : byId("fleet-rows").querySelector(`tr[aria-rowindex="${this.goal + 2}"] button`);
    if (goal) {
      this.goal = null;
      goal.focus({ preventScroll: !this.long });
    }
  }

  // The worst feeders and the shown one, with their verdicts.
  selector() {
    const box = byId("feeder");
    const own = this.beside.get(this.selected);
    const listed = own && !this.head.includes(own) ? [...this.head, own] : this.head;
    const before = new Map([...box.options].map((option) => [option.value, option]));
    const options = listed.map((feeder) => {
      const option = before.get(feeder.name) ?? el("option", { value: feeder.name });
      option.dataset.title = titleOf(feeder);
      const text = `${(feeder.name === this.selected && this.word) || wordOf(feeder)} – ${titleOf(feeder)}`;
      if (option.textContent !== text) option.textContent = text;
      return option;
    });
    const further = this.size - listed.length;
    if (further > 0) options.push(el("option", { value: "", disabled: true, text: `${further} further feeders: in the list below` }));
    if (document.activeElement !== box || options.length !== box.options.length) settle(box, options); // An open selector keeps its order.
    box.disabled = this.size < 2;
    if (own) box.value = this.selected;
  }

  // Numbers by verdict: each filters the list.
  tally() {
    const states = Object.keys(WORDS).filter((state) => this.counts[state] || this.states.has(state));
    const before = new Map([...byId("fleet-counts").children].map((node) => [node.dataset.state, node]));
    settle(byId("fleet-counts"), states.map((state) => {
      const node = before.get(state) ?? el("button", { type: "button", class: "fleet-state", "data-state": state, title: "Show these only", on: { click: () => this.filter(state) } });
      const apart = Object.entries(this.causes).filter(([, count]) => state === "undecided" && count > 0);
      const of = apart.length ? `: ${apart.map(([cause, count]) => `${count} ${APART[cause].toLowerCase()}`).join(", ")}` : "";
      const text = `${this.counts[state] ?? 0} ${WORDS[state].toLowerCase()}${of}`;
      if (node.textContent !== text) node.textContent = text;
      node.setAttribute("aria-pressed", String(this.states.has(state)));
      return node;
    }));
  }

  cells(feeder) {
    const silent = feeder.meters ? `${Math.round((100 * feeder.silent) / feeder.meters)} %` : "";
    return [stateOf(feeder), wordOf(feeder), titleOf(feeder), lasting(feeder), String(feeder.suspects || ""), silent, String(feeder.incidents || ""), String(feeder.alarms || ""), feeder.raised ? `, ${feeder.raised} new` : ""];
  }

  row(feeder, k) {
    const [state, word, title, since, suspects, silent, incidents, alarms, fresh] = this.cells(feeder);
    return el("tr", { "data-state": state, "data-feeder": feeder.name, "aria-rowindex": k + 2, "aria-current": feeder.name === this.selected ? "true" : null },
      el("td", {}, el("span", { class: "fleet-state", "data-state": state, text: word })),
      el("th", { scope: "row" }, el("button", { type: "button", class: "plain", text: title, title, on: { click: () => this.onPick(feeder.name) } }),
        title.toLowerCase().includes(feeder.name.toLowerCase()) ? null : el("span", { class: "quiet own-name", text: feeder.name })),
      el("td", { class: "num", text: since }),
      el("td", { class: "num", text: suspects }),
      el("td", { class: "num", text: silent }),
      el("td", { class: "num", text: incidents }),
      el("td", { class: "num" }, alarms, el("span", { class: "fresh", text: fresh })));
  }

  // Arrow keys walk through all rows, also those that are not loaded yet.
  key(event) {
    const row = event.target.closest("tr[data-feeder]");
    const last = (this.long ? this.total : Math.min(shortest(), this.head.length)) - 1;
    const now = Number(row?.getAttribute("aria-rowindex")) - 2;
    const next = { ArrowDown: now + 1, ArrowUp: now - 1, Home: 0, End: last }[event.key];
    if (!row || next === undefined) return;
    event.preventDefault();
    this.goal = Math.min(last, Math.max(0, next));
    this.render();
    if (this.goal !== null) byId("fleet-scroll").scrollTop = this.goal * rowHeight() - byId("fleet-scroll").clientHeight / 2; // Loads the rows there.
  }
}
