// Names of devices on the page: id of the meter, then its customer. Layouts, states and alarms give the customers.

import { deviceName } from "./dom.js";

export const BUSBAR = "substation";

const owners = new Map(); // Customer of every known meter, and meter of every known customer, by feeder.

function known(feeder) {
  if (!owners.has(feeder)) owners.set(feeder, { customer: new Map(), meter: new Map() });
  return owners.get(feeder);
}

function remember(feeder, meter, customer) {
  if (!meter || !customer) return;
  known(feeder).customer.set(meter, customer);
  known(feeder).meter.set(customer, meter);
}

export function rememberLayout({ name, layout }) {
  owners.delete(name); // Other tables may have moved a meter.
  for (const { meter, customer } of layout.customers) remember(name, meter, customer);
}

export const meterName = (feeder, meter) => (meter === BUSBAR ? "substation · busbar meter" : deviceName(meter, known(feeder).customer.get(meter)));

// Name of a customer's connection point, for its inverter or its powers.
export const customerName = (feeder, customer) => deviceName(known(feeder).meter.get(customer), customer);

// Device of an alarm: a customer's inverter, a meter, or none for an alarm of the whole feeder.
export function subjectOf({ feeder, customer, meter, evidence }) {
  remember(feeder, meter, customer ?? evidence?.customer);
  return meter ? meterName(feeder, meter) : customer ? customerName(feeder, customer) : "";
}
