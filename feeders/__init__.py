"""Real feeders: file format, converters, full AC power flow, recorded scenarios, studies."""
