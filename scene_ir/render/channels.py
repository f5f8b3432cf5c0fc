"""Channel indices of the packed values of texels, pixels and vertices, for torch and kernels alike.

A name is the index where a quantity begins; a quantity of several numbers ends where the next one begins.
"""

from __future__ import annotations

# Of a texel: premultiplied RGB, opacity; how far nearer objects hid it; how deep inside the photographed mesh it
# is, px, see `texture.outline_share`; depth, m; whether the vehicle is near it at all.
ALPHA, HIDDEN, INSET, DEPTH, SUPPORT, TEXEL = 3, 4, 5, 6, 7, 8

# Of a pixel's look at the photograph: displacement of its lookup, px (2); w then and now, m; cosine towards the
# camera now minus then, and then; share of paint; height, 0 at the vehicle's foot and 1 at its roof; how much
# brighter the surface is since it turned, see `texture.limit_brightening`.
DISPLACEMENT, W_THEN, W_NOW, TURNED, COS_THEN, PAINT, HEIGHT, BRIGHTER, LOOKUP = 0, 2, 3, 4, 5, 6, 7, 8, 9

# Of a vertex before the division that makes it a look, in place of these four: clip then minus now (3), w then.
CORNER_W, CORNER_THEN = 2, 3

# Of a mesh's own attributes, as a template shows them: colour (3), normal (3), shares of paint and glass, depth,
# m, and height; then of the vehicle as the photograph shows its other side: clip coordinates there (3), cosine
# towards the camera there; and its finish: gain (3) and lift, see `finish.fit_finish`.
NORMAL, OWN_PAINT, OWN_GLASS, OWN_DEPTH, OWN_HEIGHT = 3, 6, 7, 8, 9
MIRROR, MIRROR_COS, GAIN, LIFT, OWN = 10, 13, 14, 17, 18
PLAIN = MIRROR
"""Channels of a template without photograph."""
