"""Dark frames: level, temporal noise, glow over the field, patterns of rows and columns, defective pixels."""
