// Places of a feeder's lines, customers and collapsed branches in px, for both views: one-line and map.

import { fitted } from "./layout.js";

const STEP = [26, 104]; // Least and largest length of a step along a row, px.
const ROW = [58, 120]; // Least and largest distance of rows, px.
const UPRIGHT = { step: [32, 32], row: [84, 120] };
const NARROW = 620; // Width below which rows stand upright, px.
const FEW = 8; // Columns that fit a narrow window without that.
const PAD = 26;
const BEND = 18; // Largest height of a tie above its row, px.
const SMALL = 0.7; // Least magnification of the whole drawing before branches collapse.
const SMALLEST = 0.45; // The same while nothing must be read: no customer stands out.

const clamp = (value, [low, high]) => Math.min(high, Math.max(low, value));

// Least magnification that shows the whole drawing.
const least = (shown) => (shown.size ? SMALL : SMALLEST);

/* The one-line view.
   window: width and height, px; shown: customers that never collapse; whole: nothing collapses; beyond: customers
   that collapse only if the drawing does not fit otherwise. */
export function onePlaces(layout, window, { shown, whole, beyond = new Set() }) {
  const best = (shape) => {
    const all = placed(layout, window, { shown: new Set([...shown, ...beyond]), whole }, shape);
    return all.fits || !beyond.size ? all : placed(layout, window, { shown, whole }, shape);
  };
  const lying = best({ step: STEP, row: ROW, upright: false });
  const upright = window.width < NARROW && (lying.grid.columns > FEW || lying.grid.stubs.length > 0);
  return upright ? best({ ...UPRIGHT, upright }) : lying;
}

function placed(layout, { width, height }, { shown, whole }, { step, row, upright }) {
  const [along0, across0] = upright ? [height, width] : [width, height];
  const k = least(shown);
  const fits = ({ rows, columns }) => whole || (columns * step[0] * k <= along0 - 2 * PAD && rows * row[0] * k <= across0 - PAD);
  const grid = fitted(layout, fits, shown);
  const along = clamp((along0 - 2 * PAD - 10) / grid.columns, step);
  const across = clamp((across0 - PAD - 12) / grid.rows, row);
  const size = clamp(Math.min(along / 52, across / 76), [1, 1.35]);
  const air = layout.ties?.length ? BEND : 0; // Room for ties of the first row.
  const at = (x, line) => (upright
    ? { x: PAD + air + line * across, y: PAD + 12 + x * along }
    : { x: PAD + x * along, y: PAD + 6 + air + line * across });
  const drop = Math.min(29 * size, across - 24);
  const hang = upright ? { x: 28, y: 0 } : { x: 0, y: drop };
  const hung = (place) => ({ x: place.x + hang.x, y: place.y + hang.y });
  const join = (x0, row0, x, line) => {
    const [a, b] = [at(x0, row0), at(x, line)];
    return upright ? `M${a.x} ${a.y}H${b.x}V${b.y}` : `M${a.x} ${a.y}V${b.y}H${b.x}`;
  };
  const wires = grid.lines.map((line) => ({ d: join(line.x0, line.row0, line.x, line.row), bus: line.bus }));
  for (const bus of grid.buses) {
    if (bus.to > bus.x) wires.push({ d: join(bus.x, bus.row, bus.to, bus.row), bus: bus.bus });
    const { x, y } = at(bus.x, bus.row);
    if (bus.bare) wires.push({ d: upright ? `M${x - 5} ${y}h10` : `M${x} ${y - 5}v10`, bus: bus.bus, kind: "bus" });
  }
  const spots = [];
  for (const fork of grid.forks) {
    const [a, b] = [at(fork.x, fork.row), at(fork.to, fork.row)];
    const [x, y] = [(a.x + b.x) / 2 + hang.x / 3, (a.y + b.y) / 2 + hang.y / 3];
    wires.push({ d: upright ? `M${x - hang.x / 3} ${y}H${x}M${x} ${a.y}V${b.y}` : `M${x} ${y - hang.y / 3}V${y}M${a.x} ${y}H${b.x}`, bus: fork.bus, kind: "drop" });
  }
  for (const c of grid.customers) {
    const from = at(c.x, c.row);
    const [x, y] = c.fork ? [hang.x / 3, hang.y / 3] : [0, 0];
    wires.push({ d: `M${from.x + x} ${from.y + y}l${hang.x - x} ${hang.y - y}`, bus: c.bus, kind: "drop" });
    if (c.customer !== null) spots.push({ customer: c.customer, ...hung(from), order: c.row * 1e4 + c.x });
  }
  const stubs = grid.stubs.map((stub) => {
    const from = at(stub.x + 0.5, stub.row);
    if (!stub.inline) wires.push({ d: `M${from.x} ${from.y}l${hang.x} ${hang.y}`, bus: stub.bus, kind: "drop" });
    return { ...stub, ...(stub.inline ? from : hung(from)), order: stub.row * 1e4 + stub.x };
  });
  wires.push(...ties(layout, grid, stubs, { at, hung, upright }));
  const [first, last] = [at(0, 0), at(0, grid.rows - 1)];
  wires.push({ d: upright ? `M${first.x - 12} ${first.y}H${last.x + 12}` : `M${first.x} ${first.y - 12}V${last.y + 12}`, bus: 0, kind: "busbar" });
  const end = at(grid.columns - 1, grid.rows - 1);
  return {
    grid, fits: fits(grid), wires, spots, stubs, upright, size, gap: along, pitch: across,
    world: upright ? { width: end.x + 84, height: end.y + 24 } : { width: Math.max(end.x + PAD + 12, 200), height: end.y + drop + 52 * size },
    // Beyond the end of the busbar, where the drawing is empty.
    busbar: upright ? { x: last.x + 27, y: first.y } : { x: first.x, y: last.y + 27 },
    title: `One-line diagram, ${layout.customers.length} customers`,
  };
}

// Lines that close loops, bent so that the row of the loop does not hide them.
function ties(layout, grid, stubs, { at, hung, upright }) {
  const places = new Map();
  for (const b of grid.buses) places.set(b.bus, at(b.x, b.row));
  for (const f of grid.forks) places.set(f.bus, at((f.x + f.to) / 2, f.row));
  for (const c of grid.customers) if (c.bus !== c.from) places.set(c.bus, hung(at(c.x, c.row)));
  for (const stub of stubs) for (const bus of stub.buses) places.set(bus, stub);
  return (layout.ties ?? []).map(([one, other]) => {
    const [a, b] = [[one, other], [other, one]].map(([bus, far]) => {
      if (places.has(bus)) return places.get(bus);
      // A tie meets the busbar at the row of its other end.
      const [origin, there] = [at(0, 0), places.get(far) ?? at(0, 0)];
      return upright ? { x: there.x, y: origin.y } : { x: origin.x, y: there.y };
    });
    const bend = Math.min(2 * BEND, 12 + 0.2 * Math.hypot(b.x - a.x, b.y - a.y));
    const middle = { x: (a.x + b.x) / 2 - (upright ? bend : 0), y: (a.y + b.y) / 2 - (upright ? 0 : bend) };
    return { d: `M${a.x} ${a.y}Q${middle.x} ${middle.y} ${b.x} ${b.y}`, kind: "tie" };
  });
}

// Median distance of the nearest neighbours, px.
function spacing(spots) {
  const near = spots.map((a) => Math.min(...spots.map((b) => (a === b ? Infinity : Math.hypot(a.x - b.x, a.y - b.y)))));
  return near.filter(Number.isFinite).sort((a, b) => a - b)[near.length >> 1] ?? 100;
}

// The map: north up, in true proportions.
export function mapPlaces(layout, window) {
  const { xy, parent, buses, customers } = layout;
  const [xs, ys] = [xy.map((p) => p[0]), xy.map((p) => p[1])];
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const span = [right - left || 1, high - low || 1];
  const pad = 44;
  const factor = Math.min((window.width - 2 * pad) / span[0], (window.height - 2 * pad) / span[1]);
  const world = { width: window.width, height: Math.max(240, span[1] * factor + 2 * pad) };
  const at = (k) => ({
    x: world.width / 2 + (xs[k] - (left + right) / 2) * factor,
    y: world.height / 2 - (ys[k] - (low + high) / 2) * factor,
  });
  const wires = buses.slice(1).map((_, i) => {
    const [a, b] = [at(parent[i + 1] ?? 0), at(i + 1)];
    return { d: `M${a.x} ${a.y}L${b.x} ${b.y}`, bus: i + 1 };
  });
  for (const [one, other] of layout.ties ?? []) {
    const [a, b] = [at(one), at(other)];
    wires.push({ d: `M${a.x} ${a.y}L${b.x} ${b.y}`, kind: "tie" });
  }
  const { x, y } = at(0);
  const index = new Map(buses.map((id, k) => [id, k]));
  const here = new Map();
  const spots = customers.map((c, k) => {
    const bus = index.get(c.bus) ?? 0;
    const count = here.get(bus) ?? 0;
    here.set(bus, count + 1);
    const place = at(bus);
    return { customer: k, x: place.x + 15 * count, y: place.y, order: k };
  });
  return {
    wires, spots, stubs: [], upright: false, size: 1, gap: spacing(spots), pitch: Infinity, world, busbar: { x, y: y - 20 },
    station: { x, y }, title: `Map, ${customers.length} customers`,
  };
}
