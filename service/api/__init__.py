"""HTTP interface: REST, server-sent events, web page."""
