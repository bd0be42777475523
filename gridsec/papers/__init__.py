"""The examples of the papers: their numbers and figures beside ours. Each module has a `reproduce`."""
