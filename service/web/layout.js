// Places of a feeder's tree on a grid: every line from the busbar becomes a row, with its customers below.
// A row follows the branch with the most customers; each side branch gets a separate row, as near as it fits.
// One grid step along the row is one customer or one bus. Buses without a customer, a branching or a tie are
// parts of the line through them. Quiet branches collapse to stubs until the drawing fits. A bus with a few
// customers and nothing else hangs below the row as a fork.

const FORK = 4; // Largest number of customers of a fork.
const LEAST = 2; // Smallest number of customers of a collapsed branch.
const LEAST_RUN = 3; // Smallest number of customers of a collapsed part of a row: its stub takes two steps.

// The tree with contracted chains. A bus is drawn if it is the busbar, a branching, or has a customer or a tie.
export function contracted({ buses, parent, customers, ties = [] }) {
  const n = buses.length;
  const up = (k) => parent[k] ?? 0;
  const index = new Map(buses.map((id, k) => [id, k]));
  const at = Array.from({ length: n }, () => []);
  customers.forEach((c, k) => at[index.get(c.bus) ?? 0].push(k));
  const tied = new Set(ties.flat());
  const used = at.map((here, k) => here.length + (tied.has(k) ? 1 : 0));
  const weight = at.map((here) => here.length);
  const forks = new Array(n).fill(0);
  for (let k = n - 1; k > 0; k -= 1) {
    used[up(k)] += used[k];
    weight[up(k)] += weight[k];
    if (used[k]) forks[up(k)] += 1;
  }
  const drawn = at.map((here, k) => k === 0 || (used[k] > 0 && (here.length > 0 || forks[k] > 1 || tied.has(k))));
  const children = Array.from({ length: n }, () => []);
  const through = Array.from({ length: n }, () => []); // Buses of the line to a drawn bus, itself the last.
  const from = new Array(n).fill(0);
  const leftOut = [];
  for (let k = 1; k < n; k += 1) {
    const p = up(k);
    from[k] = drawn[p] ? p : from[p];
    if (!used[k]) leftOut.push(k); // A dead end without customers.
    if (!drawn[k]) continue;
    children[from[k]].push(k);
    for (let bus = k; bus !== from[k]; bus = up(bus)) through[k].unshift(bus);
  }
  const depth = new Array(n).fill(1);
  for (let k = n - 1; k > 0; k -= 1) if (drawn[k]) depth[from[k]] = Math.max(depth[from[k]], depth[k] + 1);
  const heavier = (a, b) => weight[b] - weight[a] || depth[b] - depth[a] || a - b;
  for (const each of children) each.sort(heavier);
  return { children, at, weight, through, from, leftOut, size: n };
}

// All customers and all buses below a drawn bus, itself included, the nearest first.
function below(tree, start) {
  const found = { customers: [], buses: [] };
  const queue = [start];
  for (let k = 0; k < queue.length; k += 1) {
    const bus = queue[k];
    found.customers.push(...tree.at[bus]);
    found.buses.push(...tree.through[bus]);
    queue.push(...tree.children[bus]);
  }
  return found;
}

// Number of customers below each bus that must stay visible.
function visible(tree, shown) {
  const count = tree.at.map((here) => here.filter((customer) => shown.has(customer)).length);
  for (let k = tree.size - 1; k > 0; k -= 1) if (tree.through[k].length) count[tree.from[k]] += count[k];
  return count;
}

// Sizes of the quiet side branches, ascending: a level collapses those up to one size.
function sizes(tree, loud) {
  const found = new Set();
  for (let bus = 1; bus < tree.size; bus += 1) {
    for (const side of tree.children[bus].slice(1)) if (!loud[side] && tree.weight[side] >= LEAST) found.add(tree.weight[side]);
  }
  return [...found].sort((a, b) => a - b);
}

/* The drawing with as few collapsed customers as `fits({ rows, columns })` needs; `shown` are those that never
   collapse. If nothing fits, the smallest drawing. */
export function fitted(layout, fits, shown = new Set()) {
  const tree = contracted(layout);
  const loud = visible(tree, shown);
  const steps = [0, ...sizes(tree, loud)];
  const levels = [...steps.map((side) => ({ side })), { side: Infinity, runs: true }, { side: Infinity, runs: true, lines: true }];
  const draw = (k) => oneLine(layout, { tree, loud, ...levels[k] });
  let [low, high] = [0, levels.length - 1];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (fits(draw(middle))) high = middle;
    else low = middle + 1;
  }
  return draw(low);
}

/* Places of buses, customers, lines and stubs.
   side: largest number of customers of a side branch that collapses; runs: quiet parts of rows collapse as well;
   lines: lines out of the busbar collapse into its row. */
export function oneLine(layout, { tree = contracted(layout), loud = null, side: most = 0, runs = false, lines = false } = {}) {
  const { children, at, weight, through } = tree;
  const quiet = (bus) => loud !== null && !loud[bus];
  const isDrop = (bus) => children[bus].length === 0;
  const isFork = (bus) => !isDrop(bus) && weight[bus] <= FORK && children[bus].every((child) => isDrop(child) && at[child].length > 0);
  const least = (bus) => (isDrop(bus) || isFork(bus) ? LEAST_RUN : LEAST);
  const collapsed = (bus, first) => quiet(bus) && weight[bus] >= least(bus) && !first && weight[bus] <= most;
  const empty = () => ({ buses: [], customers: [], lines: [], stubs: [], forks: [] });
  const stub = (bus, fields) => ({ key: `branch ${bus}`, bus, ...below(tree, bus), ...fields });

  // The buses of a row, with what hangs from each of them and its side branches.
  function trunk(start) {
    const row = [];
    for (let bus = start; bus !== undefined; ) {
      const stubs = children[bus].filter((child, k) => collapsed(child, k === 0 && !runs));
      let [next, ...others] = children[bus].filter((child) => !stubs.includes(child));
      if (runs && next === undefined && stubs.length) next = stubs.shift(); // The row goes on to its end.
      if (next !== undefined && isDrop(next) && !at[bus].length && bus !== start) {
        [next, others] = [undefined, [next, ...others]]; // A pole at the end of a line: all its customers are drops.
      }
      const drops = others.filter(isDrop);
      const forks = others.filter(isFork);
      const hanging = drops.flatMap((drop) =>
        at[drop].length ? at[drop].map((customer) => ({ customer, bus: drop })) : [{ customer: null, bus: drop }]);
      const own = at[bus].map((customer) => ({ customer, bus }));
      const silent = loud !== null && !(loud[bus] - (next === undefined ? 0 : loud[next]));
      row.push({
        bus, stubs, slots: [...own, ...hanging], forks, sides: others.filter((child) => !isDrop(child) && !isFork(child)), silent,
        count: weight[bus] - (next === undefined ? 0 : weight[next]),
      });
      bus = next;
    }
    return row;
  }

  // Quiet neighbours of a row become one item.
  function grouped(row) {
    const out = [];
    for (let k = 0; k < row.length; ) {
      let end = k;
      while (end < row.length && row[end].silent) end += 1;
      const run = row.slice(k, end);
      if (run.reduce((sum, node) => sum + node.count, 0) >= LEAST_RUN) out.push({ run });
      else out.push(...run);
      if (end < row.length) out.push(row[end]);
      k = end + 1;
    }
    return out;
  }

  // A block: items with rows counted from its first row, and the occupied spans of each row.
  function block(start, x0) {
    const items = empty();
    const taken = [];
    const branches = [];
    let x = x0;
    let before = null;
    const extend = (bus, first) => {
      if (before !== null) items.lines.push({ bus, through: through[bus], from: before.bus, x: first, row: 0, x0: before.to, row0: 0 });
    };
    const row = trunk(start);
    for (const node of runs ? grouped(row) : row) {
      const first = x;
      if (node.run) {
        const [head, tail] = [node.run[0].bus, node.run.at(-1).bus];
        const rest = children[tail].find((child) => !quiet(child));
        const inside = below(tree, head);
        const after = rest === undefined ? { customers: [], buses: [] } : below(tree, rest);
        const gone = new Set(after.customers);
        const away = new Set(after.buses);
        items.stubs.push({
          key: `run ${head}`, bus: head, inline: true, x, row: 0,
          customers: inside.customers.filter((c) => !gone.has(c)), buses: inside.buses.filter((b) => !away.has(b)),
        });
        extend(head, first);
        x += 2;
        items.buses.push({ bus: tail, x: first, to: x - 1, row: 0, bare: false });
        before = { bus: tail, to: x - 1 };
        continue;
      }
      const { bus, slots, stubs, forks, sides } = node;
      if (sides.length) x += 1;
      for (const { customer, bus: where } of slots) items.customers.push({ customer, bus: where, from: bus, x: x++, row: 0 });
      let end = Math.max(first, x - 1); // Place of the last thing that hangs from the bus.
      for (const fork of forks) {
        const from = x;
        const ends = [...at[fork].map((customer) => ({ customer, bus: fork })), ...children[fork].flatMap((drop) => at[drop].map((customer) => ({ customer, bus: drop })))];
        for (const { customer, bus: where } of ends) items.customers.push({ customer, bus: where, from: fork, x: x++, row: 0, fork: true });
        end = (from + x - 1) / 2;
        items.forks.push({ bus: fork, from: bus, x: from, to: x - 1, row: 0 });
      }
      for (const child of stubs) {
        items.stubs.push(stub(child, { from: bus, x, row: 0, inline: false }));
        x += 2;
        end = x - 1.5;
      }
      x = Math.max(first + 1, x);
      items.buses.push({ bus, x: first, to: end, row: 0, bare: !slots.length && !stubs.length && !forks.length });
      extend(bus, first);
      before = { bus, to: items.buses.at(-1).to };
      for (const side of sides) branches.push({ side, x: first });
    }
    taken[0] = [[x0, x - 1]];
    // The outermost side branches are placed first: no connector then crosses a row.
    for (const { side, x: from } of branches.reverse()) {
      const inner = block(side, from + 1);
      const overlap = (a, k) => (taken[k] ?? []).some((b) => a[0] <= b[1] && b[0] <= a[1]);
      const wider = inner.taken.map((spans) => spans.map(([a, b]) => [a - 1, b]));
      let offset = 1;
      while (wider.some((spans, k) => spans.some((a) => overlap(a, offset + k)))) offset += 1;
      merge(items, inner.items, offset);
      items.lines.push({ bus: side, through: through[side], x: from + 1, row: offset, x0: from, row0: 0 });
      wider.forEach((spans, k) => (taken[offset + k] ??= []).push(...spans));
      for (let k = 1; k < offset; k += 1) (taken[k] ??= []).push([from, from]);
    }
    return { items, taken };
  }

  function merge(items, inner, offset) {
    for (const b of inner.buses) items.buses.push({ ...b, row: b.row + offset });
    for (const c of inner.customers) items.customers.push({ ...c, row: c.row + offset });
    for (const f of inner.forks) items.forks.push({ ...f, row: f.row + offset });
    for (const s of inner.stubs) items.stubs.push({ ...s, row: s.row + offset });
    for (const l of inner.lines) items.lines.push({ ...l, row: l.row + offset, row0: l.row0 + offset });
  }

  const all = empty();
  let row = 0;
  let columns = 1;
  const whole = lines ? children[0].filter((child) => quiet(child) && weight[child]) : [];
  if (at[0].length || whole.length) {
    let x = 1;
    for (const customer of at[0]) all.customers.push({ customer, bus: 0, from: 0, x: x++, row });
    const single = whole.filter((child) => isDrop(child) && weight[child] < least(child));
    for (const child of single) for (const customer of at[child]) all.customers.push({ customer, bus: child, from: 0, x: x++, row });
    for (const child of whole.filter((each) => !single.includes(each))) {
      all.stubs.push(stub(child, { from: 0, x, row, inline: false }));
      x += 2;
    }
    all.lines.push({ bus: 0, through: [], x: x - 1 - (all.stubs.length ? 0.5 : 0), row, x0: 0, row0: row, busbar: true });
    columns = x;
    row += 1;
  }
  for (const child of children[0].filter((each) => !whole.includes(each)).sort((a, b) => a - b)) {
    const inner = block(child, 1);
    merge(all, inner.items, row);
    all.lines.push({ bus: child, through: through[child], x: 1, row, x0: 0, row0: row });
    columns = Math.max(columns, ...inner.taken.flat().map((span) => span[1] + 1));
    row += inner.taken.length;
  }
  return { ...all, rows: Math.max(row, 1), columns, leftOut: tree.leftOut };
}

// True if every bus has coordinates and they are not all the same.
export function hasMap({ xy }) {
  if (!xy || xy.some((p) => !p || !p.every(Number.isFinite))) return false;
  return new Set(xy.map(String)).size > xy.length / 4;
}
