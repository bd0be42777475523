// The form of all actions of operators: name, further fields, and a comment or a reason.

import { byId, el } from "./dom.js";
import { session } from "./session.js";

const ROWS = ["to", "scope", "duration", "times"]; // Fields that a part of the actions has.

let asking = null;
let place = null; // Selector of the item from which the form was opened.

export async function post(url, body) {
  const response = await fetch(url, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  const answer = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(answer.detail || `${response.status} ${response.statusText}`);
  return answer;
}

export const local = (t) => {
  const date = new Date(t * 1000);
  return new Date(date - date.getTimezoneOffset() * 60000).toISOString().slice(0, 16);
};

/* Open the form. `title`, `what`, `verb`: texts; `text`: name of the text field, which `needed` requires.
   `to`: text; `scope`, `duration`: [value, text] of each choice; `times`: [from, until], Unix s.
   `send` takes the name (a name, or nothing by the credential) and the values; the form closes when it resolves. */
export function ask(action) {
  place = placeOf(document.activeElement);
  asking = { text: "Comment", ...action };
  byId("act-title").textContent = action.title;
  byId("act-what").textContent = action.what;
  byId("act-send").textContent = action.verb;
  byId("act-text-name").textContent = asking.text + (action.needed ? "" : " (optional)");
  byId("act-text").value = "";
  byId("act-text").required = Boolean(action.needed);
  for (const name of ROWS) byId(`act-${name}-row`).hidden = action[name] === undefined;
  byId("act-to").value = action.to ?? "";
  for (const name of ["scope", "duration"]) {
    byId(`act-${name}`).replaceChildren(...(action[name] ?? []).map(([value, text]) => el("option", { value, text })));
  }
  ["from", "until"].forEach((name, k) => {
    byId(`act-${name}`).required = action.times !== undefined;
    byId(`act-${name}`).value = action.times ? local(action.times[k]) : "";
  });
  complain(null);
  session.ask("act-who");
  byId("act").showModal();
  // The first empty field has the focus: a known name is not typed again.
  if (session.complete("act-who")) byId(action.to === undefined ? "act-text" : "act-to").focus();
}

function placeOf(node) {
  const [list, item] = [node.closest("ol[id]"), node.closest("[data-alarm], [data-incident]")];
  if (!list || !item) return null;
  const [name, id] = Object.entries({ alarm: item.dataset.alarm, incident: item.dataset.incident }).find(([, value]) => value);
  return `#${list.id} [data-${name}="${CSS.escape(id)}"]`;
}

// The item may be drawn again: its first action has the focus instead of the button that was pressed.
function close() {
  byId("act").close();
  const lost = document.activeElement === document.body || byId("act").contains(document.activeElement);
  if (place === null || !lost) return;
  (document.querySelector(`${place} :is(.line, .ack, .withdraw)`) ?? document.querySelector(`${place} button`))?.focus();
}

function complain(problem) {
  byId("act-error").textContent = problem ?? "";
  byId("act-error").hidden = problem === null;
}

// Names of required fields without a value.
function missing() {
  const found = [];
  if (!session.complete("act-who")) found.push("your name");
  if (asking.needed && byId("act-text").value.trim() === "") found.push(`the ${asking.text.toLowerCase()}`);
  return found;
}

async function submit(event) {
  event.preventDefault();
  const wanted = missing();
  if (wanted.length) {
    complain(`Please enter ${wanted.join(" and ")}.`);
    return;
  }
  const time = (name) => new Date(byId(name).value).getTime() / 1000;
  const values = {
    text: byId("act-text").value, to: byId("act-to").value.trim() || null, scope: byId("act-scope").value,
    duration: Number(byId("act-duration").value), from: time("act-from"), until: time("act-until"),
  };
  byId("act-send").disabled = true;
  try {
    await asking.send(session.operator("act-who"), values);
    close();
  } catch (error) {
    complain(`Not done: ${error.message}`);
  } finally {
    byId("act-send").disabled = false;
  }
}

byId("act-form").addEventListener("submit", submit);
byId("act-cancel").addEventListener("click", close);
