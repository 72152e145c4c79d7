"""Routes under /api/v1: each parses, calls one verb of `lab`, and returns a schema."""
