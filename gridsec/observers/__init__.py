"""Observer families: one module is one family, with `design`, `init` and `step`."""
