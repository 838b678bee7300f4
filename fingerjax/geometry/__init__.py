"""Shape of a fingertip: sections, the layered solid through them, and the presets."""
