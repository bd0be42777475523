// Labels of suspects: each stands beside its symbol, where it covers no suspect and no label, and few other symbols;
// a near place is better than a free one far away.

const CHARACTER = 9.4; // Largest mean width of a bold character at 12 px, that of an id such as m101, px.
const LINE = 13; // Height of a line, px.
const CASING = 3; // Margin of the text, as its stroke, px.
const FAR = 8; // A label that is so much farther away may cover a symbol less, px.
const BESIDE = 4; // Number of places beside the symbol.
const NEAR = 40; // Distance of suspects within which the sides of their labels matter, px.

const least = (all, cost) => all.reduce((best, one) => (best === undefined || cost(one) < cost(best) ? one : best), undefined);

const over = (a, b) => a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height;

/* Places of labels in the window. `marks`: point { x, y }, radius, lines of text; in the order of their rank.
   `others`: points and radii of all other symbols; `wide`: half their width, if larger.
   Returns for each mark { x, y, anchor } of its first line relative to the point. */
const square = ({ x, y, radius, wide = radius }) => ({ x: x - wide, y: y - radius, width: 2 * wide, height: 2 * radius });

export function placeLabels(marks, others, { width, height }) {
  const taken = marks.map(square);
  const symbols = others.map(square);
  return marks.map((mark, own) => {
    const wide = CHARACTER * Math.max(...mark.lines.map((line) => line.length));
    const tall = LINE * mark.lines.length + CASING;
    const middle = 10 - tall / 2;
    const [side, below, above] = [mark.radius + 3, mark.radius + 11, -mark.radius - tall + 7];
    const choices = [
      { x: 0, y: below, anchor: "middle" },
      { x: side, y: middle, anchor: "start" },
      { x: 0, y: above, anchor: "middle" },
      { x: -side, y: middle, anchor: "end" },
      ...[1, -1, 2, -2, 3, -3].flatMap((k) => [{ x: side, y: middle + k * tall, anchor: "start" }, { x: -side, y: middle + k * tall, anchor: "end" }]),
      ...[1, 2, 3].flatMap((k) => [{ x: 0, y: below + k * tall, anchor: "middle" }, { x: 0, y: above - k * tall, anchor: "middle" }]),
    ];
    const box = ({ x, y, anchor }) => ({
      x: mark.x + x - (anchor === "middle" ? wide / 2 : anchor === "end" ? wide : 0), y: mark.y + y - 11, width: wide, height: tall,
    });
    const inside = (b) => b.x >= 0 && b.y >= 0 && b.x + b.width <= width && b.y + b.height <= height;
    const clashes = (c) => taken.filter((other, k) => k !== own && over(box(c), other)).length;
    const within = choices.filter((c) => inside(box(c)));
    const apart = within.filter((c) => clashes(c) === 0);
    // The places beside the symbol are as good as each other: the first one wins.
    const far = (c) => (choices.indexOf(c) < BESIDE ? choices.indexOf(c) / 100 : Math.hypot(c.x, c.y) / FAR);
    // Of two suspects above each other the upper one has the upper label.
    const near = marks.filter((other) => other !== mark && Math.hypot(other.x - mark.x, other.y - mark.y) < NEAR);
    const towards = (b) => near.filter((other) => (other.y - mark.y) * (b.y + tall / 2 - mark.y) > 0).length;
    const cost = (c) => symbols.filter((other) => over(box(c), other)).length + towards(box(c)) + far(c);
    const free = least(apart, cost) ?? least(within, clashes) ?? choices[0];
    taken.push(box(free));
    return free;
  });
}
