// Small helpers. Data enters the page only as text nodes and attribute values, never as markup.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "on") for (const [event, handler] of Object.entries(value)) node.addEventListener(event, handler);
    else if (name === "text") node.textContent = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

export const el = (tag, attributes = {}, ...children) => fill(document.createElement(tag), attributes, children);
export const svg = (tag, attributes = {}, ...children) =>
  fill(document.createElementNS(SVG, tag), attributes, children);
export const byId = (id) => document.getElementById(id);

// Words of causes: the service does not evaluate the readings. Such a feeder is neither clean nor without data.
export const APART = { overload: "SHED", "no-owner": "NO OWNER" };

const known = (value) => typeof value === "number" && Number.isFinite(value);
const minus = (text) => text.replace("-", "−");

export const volt = (value, digits = 1) => (known(value) ? `${minus(value.toFixed(digits))} V` : "–");
export const bare = (value, digits = 1) => (known(value) ? minus(value.toFixed(digits)) : "–");
export function signed(value, digits = 1) {
  if (!known(value)) return "–";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? (0).toFixed(digits) : `${value > 0 ? "+" : ""}${minus(text)}`;
}
export const isKnown = known;

// Name of a meter: its id, then its customer. Ids that are the same stand once; a customer without a meter alone.
export function deviceName(meter, customer) {
  const owner = customer && /^\d/.test(customer) ? `customer ${customer}` : customer;
  if (!meter || !customer || meter === customer) return meter || owner || "";
  return `${meter} · ${owner}`;
}

export function duration(seconds) {
  const s = Math.max(0, Math.round(seconds));
  if (s < 120) return `${s} s`;
  if (s < 7200) return `${Math.round(s / 60)} min`;
  if (s < 172800) return `${Math.round(s / 3600)} h`;
  return `${Math.round(s / 86400)} days`;
}

export const GUIDE = "operator-guide";

// Link to the section of a kind of alarms or incidents.
export const guideLink = (kind) => el("a", { class: "guide-link", href: `${GUIDE}#${kind}`, target: "_blank", rel: "noopener", text: "What to do" });

// Begin of a state; `ages` adds its duration.
export const sinceNode = (t) => el("span", { class: "quiet", "data-since": t, text: `since ${clock(t)}` });

// Durations up to now, Unix s by the service's clock.
export function ages(now) {
  for (const node of document.querySelectorAll("[data-since]")) {
    const t = Number(node.dataset.since);
    const text = `since ${clock(t)}${now >= t ? ` (${duration(now - t)})` : ""}`;
    if (node.textContent !== text) node.textContent = text;
  }
}

export function clock(t, { day = false } = {}) {
  const date = new Date(t * 1000);
  const time = date.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
  return day || Math.abs(Date.now() - date) > 43200000 ? `${date.toLocaleDateString()} ${time}` : time;
}

// Without a verdict no meter is shown as consistent. A meter without a usable reading is not evidence against the others.
export const vouches = ({ verdict, cause }) =>
  verdict !== "undecided" || cause === "silent-meters" || cause === "clock-offset";

// Status of a meter: a text, and a key for style sheets. Only a monitored meter can be consistent.
export function status(meter, limits, report) {
  if (!meter) return { key: "none", text: "no meter" };
  if (meter.suspect) return { key: "suspect", text: "suspect" };
  if (!meter.seen) return { key: "silent", text: "silent" };
  const { score, threshold, v_volt_estimated: v } = meter;
  // The busbar meter has no score; its field `judged` states if it is monitored.
  const judged = meter.judged ?? (known(score) && known(threshold));
  if (known(score) && known(threshold) && score > threshold) return { key: "doubtful", text: "doubtful" };
  if (meter.model_only) return { key: "unjudged", text: "not monitored" };
  if (known(v) && v > (meter.v_max_volt ?? limits.high)) return { key: "high", text: "above limit" };
  if (known(v) && v < (meter.v_min_volt ?? limits.low)) return { key: "low", text: "below limit" };
  if (!judged || !known(v) || !vouches(report)) return { key: "unjudged", text: "not monitored" };
  return { key: "ok", text: "consistent" };
}

// Reading of a suspect busbar meter and the reconstructed voltage, in a sentence.
export function busbarWords({ phase, v_volt_reported: said, v_volt_estimated: real, attack_volt_estimated: off }) {
  const where = phase ? `, phase ${phase}` : "";
  return `Busbar meter suspect${where}: reports ${volt(said)}, reconstructed ${volt(real)} (${signed(off)} V)`;
}

// Nominal voltage of every bus: behind a transformer it differs from the busbar's.
export function nominals(feeder) {
  const { buses, v_nominal_volt: own = [] } = feeder.layout;
  return new Map(buses.map((bus, k) => [bus, own[k] ?? feeder.v_nominal_volt]));
}

export async function getJson(url) {
  const response = await fetch(url, { headers: { Accept: "application/json" } });
  const body = await response.json().catch(() => ({}));
  if (!response.ok) throw Object.assign(new Error(body.detail || `${response.status} ${response.statusText}`), { answered: true, status: response.status, code: body.code });
  return body;
}

// Make nodes the children of a parent, in their order; nodes in their place are not moved.
export function settle(parent, nodes) {
  const wanted = new Set(nodes);
  for (const child of [...parent.children]) if (!wanted.has(child)) child.remove();
  nodes.forEach((node, k) => {
    if (parent.children[k] !== node) parent.insertBefore(node, parent.children[k] ?? null);
  });
}

const HELD_MS = 1000; // Longest delay of a drawing by a pressed button.

// Drawing of a list that waits for the release of a pressed button: a press and its release on two nodes are no click.
export function steady(list, draw) {
  let held = null; // Timer of a press.
  let due = false;
  const end = () => {
    clearTimeout(held);
    held = null;
  };
  const release = () => {
    end();
    if (due) drawn();
  };
  const drawn = () => {
    due = held !== null;
    if (!due) draw();
  };
  list.addEventListener("pointerdown", () => {
    end();
    held = setTimeout(release, HELD_MS);
  });
  addEventListener("click", end, true); // The click itself draws at once. It follows the release in the same task.
  for (const name of ["pointerup", "pointercancel"]) addEventListener(name, () => { if (held !== null) setTimeout(release); });
  return drawn;
}
