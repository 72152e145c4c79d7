"""How the lens and the pixel's aperture image: transfer functions, aberrated pupils, illumination."""
