"""How light becomes a raw frame: every stage once, pure numerics (arrays and a generator in, arrays out)."""

from sim.compiled_loops import choose_cache

choose_cache()  # before numba, which reads where it is when it is imported
