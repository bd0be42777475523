// Identity of the browser: login by an API key, which the service exchanges for an HttpOnly cookie.

import { byId, el } from "./dom.js";

const API = "/api/v1/session";

export const session = {
  accepted: false, // A key was accepted since the page was loaded.
  name: null, // Name by the credential; null while the service is open and the operator gives a name.

  // Resolves as soon as the service accepts the browser's requests.
  async begin() {
    for (;;) {
      const response = await fetch(API, { headers: { Accept: "application/json" } }).catch(() => null);
      if (response?.ok) {
        session.accepted = false;
        show(await response.json());
        return;
      }
      if (response?.status === 401) {
        const again = session.accepted; // The key was valid, but the browser keeps no cookie.
        await login(again ? "the browser refuses the cookie of this address; it needs HTTPS" : null);
        session.accepted = true;
      }
      else await new Promise((resolve) => { setTimeout(resolve, 3000); });
    }
  },

  // Name of the operator in a request: that of the credential is left out.
  operator(input) {
    if (session.name !== null) return {};
    const name = byId(input).value.trim();
    localStorage.setItem("gridsec.who", name);
    return { "who": name };
  },

  // Prepare the field of the operator's name.
  ask(input) {
    byId(input).closest("label").hidden = session.name !== null;
    byId(input).required = session.name === null;
    byId(input).value = localStorage.getItem("gridsec.who") ?? "";
  },

  // A name is given, or follows from the credential.
  complete(input) {
    return session.name !== null || byId(input).value.trim() !== "";
  },
};

function show(identity) {
  session.name = identity.open ? null : identity.name;
  const scope = identity.feeders === null ? "" : `, ${identity.feeders.length} feeder${identity.feeders.length === 1 ? "" : "s"}`;
  byId("identity").hidden = identity.open;
  byId("identity").replaceChildren(
    el("span", { text: `${identity.name} (${identity.role}${scope})` }),
    el("button", { type: "button", class: "plain", text: "Log out", on: { click: logout } }));
}

function login(problem) {
  byId("login-error").hidden = problem === null;
  byId("login-error").textContent = problem === null ? "" : `Not logged in: ${problem}`;
  byId("login-key").value = "";
  if (!byId("login").open) byId("login").showModal();
  return new Promise((resolve) => {
    byId("login-form").onsubmit = async (event) => {
      event.preventDefault();
      const response = await fetch(API, {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ key: byId("login-key").value.trim() }),
      }).catch((error) => error);
      if (response.ok) {
        byId("login").close();
        resolve();
        return;
      }
      const told = response instanceof Error ? response.message : (await response.json().catch(() => ({}))).detail ?? response.statusText;
      byId("login-error").textContent = `Not logged in: ${told}`;
      byId("login-error").hidden = false;
    };
  });
}

async function logout() {
  await fetch(API, { method: "DELETE" });
  location.reload();
}

byId("login").addEventListener("cancel", (event) => event.preventDefault());
