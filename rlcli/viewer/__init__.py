"""Pictures of environments: offscreen video and a native window."""
