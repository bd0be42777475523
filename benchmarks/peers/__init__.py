"""Side by side with open tools: who finds manipulated voltage meters in one snapshot, and how fast."""
