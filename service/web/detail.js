// One customer: reported and reconstructed voltage, score and threshold, and a trend.

import { bare, byId, clock, deviceName, duration, el, isKnown, nominals, signed, status, svg, volt } from "./dom.js";

const [W, H, LEFT, RIGHT, TOP, BOTTOM] = [420, 150, 46, 8, 10, 20];

function trend(points, limits, nominal) {
  const whole = points.filter((p) => isKnown(p.estimated) && isKnown(p.half));
  const values = [
    ...points.flatMap((p) => [p.reported, p.estimated]),
    ...whole.flatMap((p) => [p.estimated - p.half, p.estimated + p.half]),
  ].filter(isKnown);
  if (values.length < 2) return el("p", { class: "quiet", text: "The trend starts with the next ticks." });
  const [t0, t1] = [points[0].t, points.at(-1).t];
  let [low, high] = [Math.min(...values), Math.max(...values)];
  const air = Math.max(0.08 * (high - low), 0.001 * nominal);
  [low, high] = [low - air, high + air];
  const x = (t) => LEFT + ((t - t0) / (t1 - t0 || 1)) * (W - LEFT - RIGHT);
  const y = (v) => TOP + ((high - v) / (high - low)) * (H - TOP - BOTTOM);
  const path = (pick) => {
    let pen = "M";
    return points.map((p) => {
      const v = pick(p);
      if (!isKnown(v)) { pen = "M"; return ""; }
      const part = `${pen}${x(p.t).toFixed(1)} ${y(v).toFixed(1)}`;
      pen = "L";
      return part;
    }).join("");
  };
  const band = whole.length < 2 ? "" : `M${[
    ...whole.map((p) => `${x(p.t).toFixed(1)} ${y(p.estimated + p.half).toFixed(1)}`),
    ...whole.toReversed().map((p) => `${x(p.t).toFixed(1)} ${y(p.estimated - p.half).toFixed(1)}`),
  ].join("L")}Z`;
  const grid = [0.1, 0.5, 0.9].map((k) => low + k * (high - low)).flatMap((v) => [
    svg("line", { class: "grid", x1: LEFT, x2: W - RIGHT, y1: y(v), y2: y(v) }),
    svg("text", { class: "axis", x: LEFT - 6, y: y(v) + 4, "text-anchor": "end", text: bare(v) }),
  ]);
  const edges = [limits.low, limits.high].filter((v) => v > low && v < high).map((v) =>
    svg("line", { class: "limit", x1: LEFT, x2: W - RIGHT, y1: y(v), y2: y(v) }));
  return svg("svg", { class: "trend", viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": "Trend of reported and reconstructed voltage" },
    ...grid, ...edges,
    svg("path", { class: "band", d: band }),
    svg("path", { class: "reported", d: path((p) => p.reported) }),
    svg("path", { class: "estimated", d: path((p) => p.estimated) }),
    svg("text", { class: "axis", x: LEFT, y: H - 4, text: `${duration(t1 - t0)} ago` }),
    svg("text", { class: "axis", x: W - RIGHT, y: H - 4, "text-anchor": "end", text: clock(t1) }));
}

function gauge(meter) {
  const ratio = isKnown(meter.score) && isKnown(meter.threshold) ? meter.score / meter.threshold : null;
  if (!isKnown(ratio)) return el("p", { class: "quiet", text: "No score at this tick." });
  const words = ratio > 1
    ? `${ratio >= 10 ? Math.round(ratio) : ratio.toFixed(1)} times the threshold`
    : `${Math.round(100 * ratio)} % of the threshold`;
  const reach = 2;
  return el("div", { class: "gauge" },
    svg("svg", { viewBox: "0 0 200 22", preserveAspectRatio: "none", "aria-hidden": true },
      svg("rect", { class: "track", y: 6, width: 200, height: 10, rx: 3 }),
      svg("rect", { class: ratio > 1 ? "value over" : "value", y: 6, width: (200 * Math.min(ratio, reach)) / reach, height: 10, rx: 3 }),
      svg("line", { class: "mark", x1: 200 / reach, x2: 200 / reach, y1: 1, y2: 21 })),
    el("p", {}, `Score ${meter.score.toExponential(1)}, threshold ${meter.threshold.toExponential(1)}: `, el("b", { text: words })));
}

function row(label, value, extra) {
  return [el("dt", { text: label }), el("dd", {}, el("b", { text: value }), extra ? el("span", { class: "quiet", text: ` ${extra}` }) : null)];
}

export function showDetail(feeder, customer, { meter, inverter, alone, v, std, own, report }, points) {
  const nominal = nominals(feeder).get(customer.bus);
  const share = nominal / feeder.v_nominal_volt;
  const limits = { low: share * feeder.v_min_volt, high: share * feeder.v_max_volt };
  const pu = (value) => (isKnown(value) ? `${(value / nominal).toFixed(4)} pu` : "");
  const now = status(meter, limits, report);
  byId("detail-title").textContent = deviceName(customer.meter, customer.customer);
  const head = el("p", { class: "where" },
    el("span", { class: "state", "data-status": now.key, text: now.text }),
    el("span", { class: "quiet", text: ` ${customer.meter ? "" : "no meter, "}bus ${customer.bus}${customer.phase ? `, phase ${customer.phase}` : ""}` }));
  const half = isKnown(std) ? 3 * std : null;
  const list = el("dl", { class: "numbers" });
  if (meter) list.append(...row("Reported", volt(meter.v_volt_reported, 2), pu(meter.v_volt_reported)));
  list.append(...row(alone ? "Model only, no reading" : "Reconstructed", volt(v, 2), `${half === null ? "" : `± ${half.toFixed(2)} V, `}${pu(v)}`));
  if (half !== null) list.append(...row("Standard deviation", volt(std, 2)));
  if (own) list.append(...row(...own));
  if (meter?.suspect) list.append(...row("Manipulation", `${signed(meter.attack_volt_estimated, 2)} V`, meter.kind ?? ""));
  const error = report?.data_error;
  if (meter && error?.meters.includes(meter.meter)) list.append(...row("Files", error.proposed.join("; "), error.kind.replace("-", " ")));
  if (inverter && isKnown(inverter.q_kvar_estimated)) {
    list.append(...row("Inverter injects", `${signed(inverter.q_kvar_estimated, 1)} kvar`, inverter.judged ? "" : "by its droop curve"));
  }
  if (inverter?.suspect) list.append(...row("Manipulated by", `${signed(inverter.attack_kvar_estimated, 1)} kvar`));
  byId("detail").replaceChildren(head, list, ...(meter ? [gauge(meter)] : []),
    el("div", { class: "trend-box" }, trend(points, limits, nominal)),
    el("p", { class: "key" },
      el("span", { class: "k-estimated", text: "reconstructed" }),
      el("span", { class: "k-band", text: "its interval" }),
      el("span", { class: "k-reported", text: "reported" })));
}
