"""Examples of the papers: printed numbers and figures beside computed ones, by `reproduce` of each module."""
