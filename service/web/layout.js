// Places of a feeder's tree on a grid: every line from the busbar becomes a row, with its customers below.
// A row follows the branch with the most customers; each side branch gets a separate row, as near as it fits.
// One grid step along the row is one customer or one bus.

function tree({ buses, parent, customers }) {
  const n = buses.length;
  const children = Array.from({ length: n }, () => []);
  for (let k = 1; k < n; k += 1) children[parent[k] ?? 0].push(k);
  const index = new Map(buses.map((id, k) => [id, k]));
  const at = Array.from({ length: n }, () => []);
  customers.forEach((c, k) => at[index.get(c.bus) ?? 0].push(k));
  const weight = at.map((here) => here.length);
  const depth = new Array(n).fill(1);
  for (let k = n - 1; k > 0; k -= 1) {
    const p = parent[k] ?? 0;
    weight[p] += weight[k];
    depth[p] = Math.max(depth[p], depth[k] + 1);
  }
  return { children, at, weight, depth };
}

export function oneLine(layout) {
  const { children, at, weight, depth } = tree(layout);
  const heavier = (a, b) => weight[b] - weight[a] || depth[b] - depth[a] || a - b;
  const isDrop = (bus) => children[bus].length === 0;

  // A block: items with rows counted from its first row, and the occupied spans of each row.
  function block(start, x0) {
    const items = { buses: [], customers: [], lines: [] };
    const taken = [];
    const branches = [];
    let x = x0;
    let before = null;
    for (let bus = start; bus !== undefined; ) {
      let [next, ...others] = [...children[bus]].sort(heavier);
      if (next !== undefined && isDrop(next) && !at[bus].length && bus !== start) {
        [next, others] = [undefined, [next, ...others]]; // A pole at the end of a line: all its customers are drops.
      }
      const drops = others.filter(isDrop);
      const sides = others.filter((child) => !isDrop(child));
      const own = at[bus].map((customer) => ({ customer, bus }));
      const hanging = drops.flatMap((drop) =>
        at[drop].length ? at[drop].map((customer) => ({ customer, bus: drop })) : [{ customer: null, bus: drop }],
      );
      const slots = [...own, ...hanging];
      const first = x;
      if (sides.length) x += 1;
      slots.forEach(({ customer, bus: where }, k) => {
        items.customers.push({ customer, bus: where, from: bus, x: x + k, row: 0 });
      });
      x = Math.max(first + 1, x + slots.length);
      items.buses.push({ bus, x: first, to: x - 1, row: 0, bare: !slots.length });
      if (before !== null) items.lines.push({ bus, from: before, x: first, row: 0, x0: before.to, row0: 0 });
      before = { bus, to: x - 1 };
      for (const side of sides) branches.push({ side, x: first });
      bus = next;
    }
    taken[0] = [[x0, x - 1]];
    // The outermost side branches are placed first: no connector then crosses a row.
    for (const { side, x: from } of branches.reverse()) {
      const inner = block(side, from + 1);
      const overlap = (a, row) => (taken[row] ?? []).some((b) => a[0] <= b[1] && b[0] <= a[1]);
      const wider = inner.taken.map((row) => row.map(([a, b]) => [a - 1, b]));
      let offset = 1;
      while (wider.some((row, k) => row.some((a) => overlap(a, offset + k)))) offset += 1;
      merge(items, inner.items, offset);
      items.lines.push({ bus: side, x: from + 1, row: offset, x0: from, row0: 0 });
      wider.forEach((row, k) => (taken[offset + k] ??= []).push(...row));
      for (let k = 1; k < offset; k += 1) (taken[k] ??= []).push([from, from]);
    }
    return { items, taken };
  }

  function merge(items, inner, offset) {
    for (const b of inner.buses) items.buses.push({ ...b, row: b.row + offset });
    for (const c of inner.customers) items.customers.push({ ...c, row: c.row + offset });
    for (const l of inner.lines) items.lines.push({ ...l, row: l.row + offset, row0: l.row0 + offset });
  }

  const all = { buses: [], customers: [], lines: [] };
  let row = 0;
  let columns = 1;
  const own = at[0];
  own.forEach((customer, k) => all.customers.push({ customer, bus: 0, from: 0, x: 1 + k, row }));
  if (own.length) {
    all.lines.push({ bus: 0, x: own.length, row, x0: 0, row0: row, busbar: true });
    columns = own.length + 1;
    row += 1;
  }
  for (const child of [...children[0]].sort((a, b) => a - b)) {
    const inner = block(child, 1);
    merge(all, inner.items, row);
    all.lines.push({ bus: child, x: 1, row, x0: 0, row0: row });
    columns = Math.max(columns, ...inner.taken.flat().map((span) => span[1] + 1));
    row += inner.taken.length;
  }
  return { ...all, rows: Math.max(row, 1), columns };
}

// True if every bus has coordinates and they are not all the same.
export function hasMap({ xy }) {
  if (!xy || xy.some((p) => !p || !p.every(Number.isFinite))) return false;
  return new Set(xy.map(String)).size > xy.length / 4;
}
