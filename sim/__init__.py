"""How light becomes a raw frame: every stage once, pure numerics (arrays and a generator in, arrays out)."""
