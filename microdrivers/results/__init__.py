"""Schema-versioned results."""
