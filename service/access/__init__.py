"""Access control: certificates, rules of zenoh, signatures of readings."""
