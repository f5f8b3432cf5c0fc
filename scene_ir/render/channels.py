"""Channel indices of the packed values of texels, pixels and vertices, for torch and kernels alike.

A name is the index where a quantity begins; a quantity of several numbers ends where the next one begins.
"""

from __future__ import annotations

# Texel: premultiplied RGB, opacity; occlusion by nearer objects; distance inside the photographed mesh, px, see
# `texture.outline_share`; depth, m; support, whether the vehicle is nearby at all.
ALPHA, HIDDEN, INSET, DEPTH, SUPPORT, TEXEL = 3, 4, 5, 6, 7, 8

# Lookup of a pixel: displacement, px (2); w then and now, m; cosine towards the camera now minus then, and then;
# paint share; height, 0 at the vehicle's foot and 1 at its roof; brightening since it turned, see
# `texture.limit_brightening`.
DISPLACEMENT, W_THEN, W_NOW, TURNED, COS_THEN, PAINT, HEIGHT, BRIGHTER, LOOKUP = 0, 2, 3, 4, 5, 6, 7, 8, 9

# Vertex before the division that makes it a lookup, in place of the first four: clip then minus now (3), w then.
CORNER_W, CORNER_THEN = 2, 3

# Mesh attributes of the template: colour (3), normal (3), shares of paint and glass, depth, m, and height; of the
# photographed other side: clip coordinates (3), cosine towards the camera; finish: gain (3) and lift, see
# `finish.fit_finish`.
NORMAL, OWN_PAINT, OWN_GLASS, OWN_DEPTH, OWN_HEIGHT = 3, 6, 7, 8, 9
MIRROR, MIRROR_COS, GAIN, LIFT, OWN = 10, 13, 14, 17, 18
PLAIN = MIRROR
"""Channels of a template without photograph."""

# Maps of night: rise of a pixel's ray, metres of height per metre of depth; share of the headlamps' beam, with the
# gain of signs; light of the street lamps relative to that in a pool, for sky its glow relative to the horizon's;
# share of the pixel that shines; loss of light towards the corners; standard normal noise (3); glare (3), light; what a
# wet road mirrors of lamps (3), light.
RISE, AIM, STREET, LIT, CORNER, NOISE, GLARE, WET, NIGHT_MAPS = 0, 1, 2, 3, 4, 5, 8, 11, 14
