"""State observers of any system: one module is one kind, with `design`, `init` and `step`."""
