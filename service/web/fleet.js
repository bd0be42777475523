// All feeders, the worst first: verdict, its duration, suspects, silent meters, alarms. Shown with two feeders or more.

import { byId, duration, el, getJson, isKnown, settle } from "./dom.js";
import { session } from "./session.js";

const API = "/api/v1/feeders";
const EVERY_MS = 2000;
const SHOWN = 8; // Rows of the short list.
const MOST = 500; // Rows of the long list; the filter finds the others.
const WORDS = { attacked: "ATTACKED", undecided: "UNDECIDED", nodata: "NO DATA", unwatched: "NOT MONITORED", clean: "CLEAN" };
const RANK = Object.keys(WORDS); // Worst first.

// State of a feeder: its verdict, unless no value uses a present reading.
export function stateOf(feeder) {
  if (feeder.phase === "failed") return "unwatched";
  const stale = isKnown(feeder.age_s) && isKnown(feeder.patience_s) && feeder.age_s > feeder.patience_s;
  if (!feeder.verdict || feeder.model_only || stale) return "nodata";
  return feeder.displayed_verdict ?? feeder.verdict;
}

export const worstFirst = (a, b) => RANK.indexOf(stateOf(a)) - RANK.indexOf(stateOf(b))
  || b.suspects - a.suspects || b.raised - a.raised || (a.since ?? 0) - (b.since ?? 0) || (a.name < b.name ? -1 : 1);

export class Fleet {
  constructor({ onPick, onChange }) {
    this.onPick = onPick;
    this.onChange = onChange; // Called with the number of attacked feeders besides the shown one.
    this.feeders = [];
    this.selected = null;
    this.rows = new Map();
    byId("fleet-all").addEventListener("toggle", () => this.render());
    byId("fleet-filter").addEventListener("input", () => this.render());
  }

  begin(feeders) {
    this.take(feeders);
    setInterval(() => this.update(), EVERY_MS);
  }

  async update() {
    if (document.visibilityState === "hidden" && this.feeders.length > SHOWN) return;
    if (this.asking) return;
    this.asking = true;
    try {
      this.take((await getJson(API)).feeders);
      byId("fleet").dataset.fresh = "yes";
    } catch (error) {
      byId("fleet").dataset.fresh = "no";
      if (error.status === 401) await session.begin();
    } finally {
      this.asking = false;
    }
  }

  take(feeders) {
    this.feeders = [...feeders].sort(worstFirst);
    this.render();
  }

  select(name) {
    this.selected = name;
    this.render();
  }

  render() {
    const several = this.feeders.length > 1;
    byId("fleet").hidden = !several;
    this.onChange(this.feeders.filter((f) => f.name !== this.selected && stateOf(f) === "attacked").length);
    if (!several) return;
    const count = new Map(RANK.map((state) => [state, 0]));
    for (const feeder of this.feeders) count.set(stateOf(feeder), count.get(stateOf(feeder)) + 1);
    byId("fleet-counts").replaceChildren(...RANK.filter((state) => count.get(state)).map((state) =>
      el("span", { class: "fleet-state", "data-state": state, text: `${count.get(state)} ${WORDS[state].toLowerCase()}` })));
    const all = byId("fleet-all").open;
    const wanted = byId("fleet-filter").value.trim().toLowerCase();
    const found = all && wanted
      ? this.feeders.filter((f) => `${f.name} ${f.title}`.toLowerCase().includes(wanted)) : this.feeders;
    const shown = found.slice(0, all ? MOST : SHOWN);
    byId("fleet-more").textContent = shown.length < found.length ? `${found.length - shown.length} further feeders` : "";
    const before = this.rows;
    this.rows = new Map(shown.map((feeder) => {
      const said = JSON.stringify([this.cells(feeder), feeder.name === this.selected]);
      const old = before.get(feeder.name);
      return [feeder.name, old?.said === said ? old : { said, node: this.row(feeder) }];
    }));
    settle(byId("fleet-rows"), [...this.rows.values()].map(({ node }) => node));
  }

  cells(feeder) {
    const state = stateOf(feeder);
    const begun = feeder.displayed_since ?? feeder.since;
    const decided = state === (feeder.displayed_verdict ?? feeder.verdict);
    const since = isKnown(begun) && isKnown(feeder.t) && decided ? duration(feeder.t - begun) : "";
    const silent = feeder.meters ? `${Math.round((100 * feeder.silent) / feeder.meters)} %` : "";
    return [state, feeder.title || feeder.name, since, String(feeder.suspects || ""), silent, String(feeder.raised || "")];
  }

  row(feeder) {
    const [state, title, since, suspects, silent, raised] = this.cells(feeder);
    return el("tr", { "data-state": state, "aria-current": feeder.name === this.selected ? "true" : null },
      el("td", {}, el("span", { class: "fleet-state", "data-state": state, text: WORDS[state] })),
      el("th", { scope: "row" }, el("button", { type: "button", class: "plain", text: title, on: { click: () => this.onPick(feeder.name) } })),
      el("td", { class: "num", text: since }),
      el("td", { class: "num", text: suspects }),
      el("td", { class: "num", text: silent }),
      el("td", { class: "num", text: raised }));
  }
}
