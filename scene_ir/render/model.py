"""The numbers of the renderer's models, once for both backends: what a photographed texel is worth where it is
shown again, daylight, paint, leaves and weather. The formulas are in `texture`, `reference` and `environment` in
plain torch, and in `kernels`.

A pair (low, high) is where a `texture.smoothstep` begins and ends. Colours are RGB display values in [0, 1].
"""

from __future__ import annotations

import math

# --------------------------------------------------------------------------- what the photograph knows of a pixel

DEPTH_TOLERANCE_M = (0.25, 0.6)
"""A point this much behind the photographed surface begins to be, and is, unseen: thicker than a mirror or a
seat."""
STRETCH = (1.0, 2.2)
"""Growth of the cosine towards the camera, in units of what the photograph saw, at which its texels begin to
smear, and at which what stands for unseen parts looks better: drawn out to twice and three times their width."""
GRAZING = (0.06, 0.04)
"""Cosine added to what the photograph saw, of all but paint and of paint: at its very outline a surface would
else have none. Tyres, arches and trims are small and curved; drawn out a little they look better than their
templates, whose dark edges lie where the mesh has them."""
SQUARED_COS = 1e-4
"""Added to that cosine's square, so that it bends smoothly to 0 where the photograph saw the back."""
SQUARE = (0.15, 0.4)
"""Cosine towards the camera from which on, and beyond which wholly, a pixel tells of the finish there: near the
outline, pixels mix with the background, and a mesh that is off by a little shows another part."""
OPEN_TURN = (0.02, 0.1)
"""Growth of that cosine over which the outline's half-transparent texels, now inside the outline, are filled."""
OPEN_ALPHA = (0.2, 0.5)
"""Opacity of those texels up to which they show the background, and from which on the vehicle, for certain."""
RIM = (0.3, 0.5)
"""That cosine, in the photograph, up to and beyond which a point is near the outline, and not."""
OUTLINE_TURN = (0.1, 0.25)
"""Change of that cosine at which a point begins to leave, and has left, the outline."""
OUTLINE_PX = (1.0, 2.2)
"""Distance inside the photographed mesh up to, and beyond, which texels belong to the outline, and to the
inside."""
BESIDE_OUTLINE_PX = (2.0, 3.0)
"""The same distance of a point at the outline now, up to which it was there in the photograph, and what is beside
it goes with it, and beyond which it was inside: the photographed outline would be a rim beside the vehicle. Two
pixels, since a point that is looked up between pixels' centres can be at the outline and lie so far inside."""
MIRRORED_RIM = (0.0, 1.0)
"""How much of a texel is outline, from which on, and where no longer, it stands for the other side: at the outline
a matte may have taken in what lies behind, and a pixel there is drawn out over many."""
MIRRORED_COS = (0.05, 0.2)
"""Cosine with which the photograph saw the other side, from which on, and beyond which wholly, it
stands for this."""
LEAST_MIRRORED_ALPHA = 0.4
"""A texel of the other side is divided by its opacity, but by no less than this."""
HIDDEN_PX = (1.0, 3.0)
"""Distance inside a nearer object's matte at which texels begin to be, and are, unknown."""
SOLID_ALPHA = (0.5, 0.95)
"""Opacity from which on, and beyond which wholly, a texel stands for more than its own place."""
SUPPORTED = (0.1, 0.9)
"""A texel's support up to which, and beyond which no longer, the photograph shows that there is no vehicle."""
BORDER_PX = (0.5, 1.5)
"""Distance beyond the photograph's border over which what it shows ends."""
EXTENDED_PX = (2.0, 14.0)
"""Distance beyond it over which a vehicle's looks at the border give way to its other side's or the template's: a
soft change shows less than a seam, and drawn out farther the border's pixels become bars."""
SHADOW_EXTENDED_PX = (4.0, 60.0)
"""The same of its shadow, which has no other side to go by, and is smooth."""
SUPPORT_PX = 2
"""Beyond the matte by more than this, the photograph shows that there is no vehicle."""
COVERED = (0.5, 1.0)
"""Coverage up to which a pixel at the mesh's outline takes its neighbours' looks, and from which on its own."""
LEAST_NEIGHBOUR = 1e-3
"""Weight of a neighbour that is hardly covered itself."""
SATURATED = 1e-6
"""A colour this near to 0 or 1 is at the bound: rounding decides on which side of it."""
FAR_AWAY_PX = 1e5
"""Where points are looked up that were behind the camera."""
SUBPIXELS = ((0, 0), (1, -3), (-1, 3), (5, 1), (-3, -5), (-5, 5), (-7, -1), (3, 7), (7, -7))
"""Places within a pixel, in its sixteenths, over which what a mesh shows of itself is averaged: trims thinner than
a pixel would be rows of dots. The centre, and eight of which no two share a row or a column (Direct3D's)."""
WALK = 8
"""So many faces a walk over the mesh passes at most to such a place."""
NEAREST_MIRRORED_M = 0.1
"""Points of the other side nearer to the camera's plane than this are looked up as there."""

# ------------------------------------------------------------------------------------------------------- daylight

GROUND_RGB, HORIZON_RGB, ZENITH_RGB = (0.30, 0.29, 0.28), (0.46, 0.47, 0.47), (0.52, 0.66, 0.86)
"""What surfaces mirror. Level with them stand houses, hedges and other cars, not the sky."""
ZENITH_UP, HORIZON_UP = (0.0, 0.9), (-0.08, 0.12)
"""How steeply up a mirrored ray points where horizon turns to zenith, and ground to horizon."""
AMBIENT = (0.30, 0.38)
"""Light from all around, and what the sky adds to a surface that looks up; in display values, as all here."""
SUNLIGHT = 0.62
"""What the sun adds to a surface that faces it, on a clear day with some haze."""
TERMINATOR = 0.01
"""Added to the square of the sun's cosine: light ends softly where a surface turns away."""
OCCLUDED = (0.45, -0.05, 0.4)
"""Light that is left at a vehicle's foot; the heights, shares of its own, between which it grows to all."""
FRESNEL = 0.04
"""Share that a surface mirrors of what it sees squarely (Schlick's approximation)."""
PAINT_MIRRORS = 0.55
GLASS_MIRRORS = (0.10, 0.75)
"""Of glass: always, and what Fresnel's share adds."""
GLINT = (0.35, 0.5)
"""The sun's highlight on paint and on glass, a cosine to the power of 40."""
RELIT = (0.3, 0.6)
"""Share of the change of light that a photographed colour follows, of all but paint and of paint: glass and rubber
show less of it, and the sun that the shading knows may be behind a tree. Held against generated truth."""
SUN_TURN_RAD, SUN_RISE_RAD, SUN_STRENGTH = math.radians(15.0), math.radians(7.5), 0.2
"""Of light code 1: turn of the sun about the vertical, rise above the horizon, share of its light that it adds."""
SUN_OFFSET_MAX_M = 4.0
"""Longest cast shadow that is kept: beyond it the penumbra of a low sun is too faint to be worth its pixels."""
LEAST_SINE = 0.3
"""Of the sun's height: lower suns cast shadows as this one does."""
SHRUNK = 0.02
"""Share of a vehicle's size, within which its shadow softly ceases to follow as the vehicle becomes smaller."""
OWN_SHADOW = 0.9
"""Cosine between a photographed shadow and that of the vehicle's box, from which on it is the vehicle's own."""
RELIT_MOST = 0.5
"""Largest share by which a photographed colour brightens or darkens as its surface turns."""

# ---------------------------------------------------------------------------------------------------------- paint

LIGHTNESS_GAIN, CHROMA_GAIN, GLOSS_GAIN, DIRT_GAIN = 2.2, 45.0, 0.9, 0.55
"""Of texture code 1: on the logit of L*, on a* and b*, on contrast about the paint's own L*; opacity of
dust."""
GLOSSY_L = 30.0
"""Difference of L* that gloss counts as 1."""
CLEAN_ROOF = 0.75
"""Share of the dust that does not stick at the roof."""
DUST_RGB = (0.47, 0.42, 0.35)
"""Dry road dust."""
LEVEL = (0.01, 0.99)
"""Bounds of L* / 100 before its logit is taken."""
GAMUT_SHARPNESS = 20.0
"""Colours bend within about 1/20 of black and white."""
LEAST_ALPHA = 0.02
"""A premultiplied colour is divided by its opacity, but by no less than this, before it is painted."""

# --------------------------------------------------------------------------------------------------------- leaves

FEWEST_LEAVES = 0.004
"""Below this share of foliage a pixel stays as it is: one step of a picture of 8 bits."""
LEAF_LIGHTNESS = 1.5
"""Of lightness code 1, on the logit of L*."""
LEAF_CHROMA = 0.3
"""What hue 1 adds to the chroma, relative."""
LEAF_TURN, LEAF_TURN_MORE, LEAF_TURN_BEND = 0.70, 0.35, 2.0
"""Turn of the hue, rad: at code 0, what tanh(`LEAF_TURN_BEND` code) adds. Green is nearer to blue
than to orange."""
LEAF_RED, LEAF_YELLOW = 10.0, 8.0
"""What hue 1 adds to a* and b* of a middle grey."""
CROWN_BEND = 6.0
"""How sharply density 0 parts thicker crowns from thinner ones."""
THICK_SHARE, THICK_DARKNESS, THIN_SHARE = 0.5, 0.25, 0.8
"""Of the thickest crown: how much of it is deep inside, and how bright that is; how far the thinnest one opens."""

GRASS_M = 0.3
"""Height above the ground from which foliage is a crown, which density changes; below it fades into grass."""

# -------------------------------------------------------------------------------------------------------- weather

LUMA = (0.299, 0.587, 0.114)
"""ITU-R BT.601."""
SKY_RGB = (0.78, 0.82, 0.87)
"""Colour of the air where the photograph shows no sky."""
SHADOW_SOFTENING = (0.5, 0.4, 0.5, 0.6)
"""Rates at which fog, rain, time and overcast weaken cast shadows."""
OVERCAST = 0.85
"""How far overcast 1 goes towards the picture under a closed cover."""
OVERCAST_COLOUR, OVERCAST_CONTRAST = 0.55, 0.88
"""What is left of colour and contrast."""
OVERCAST_FROM, OVERCAST_TO = 0.42, 0.42
"""The display value about which contrast shrinks, and where that value comes to lie."""
COVER_AIR, COVER_LIGHT, COVER_STRUCTURE = 0.55, 0.36, 0.15
"""The cover: share of the grey airlight, light of its own, and how much of the sky's own structure is left."""
OVERCAST_AIR = 0.9
"""Brightness of the airlight under it, of the grey one's."""
DARKENING = (2.0 / 2.2, 1.75 / 2.2, 1.25 / 2.2)
"""Optical depth of red, green and blue at time code 1, the light's over the display's exponent: the end of civil
twilight, blue and dark, while what stands on the road can still be told apart without lamps."""
WARMTH = (0.70, 0.12, -0.42)
"""What dusk, at half the time code, adds to red, green and blue."""
DUSK_ENDS, DIMMING, DIMMING_ENDS = 3.5, 0.25, 2.0
"""Rates in the code's square at which that warmth and an early dimming end again, and how strong the latter is."""
DAMP = 0.9
"""How far rain 1 goes towards the wet picture."""
DAMP_LIGHT, DAMP_COLOUR = 1.0, 0.75
"""What is left of light and colour in that."""
SHEEN_NEAR, SHEEN_FAR, SHEEN_M = 0.10, 0.30, (4.0, 45.0)
"""How much of a wet road is sheen near the camera, what is added far away, and the distances between
which it is."""
SHEEN_MIRROR, SHEEN_AIR = 0.55, 0.40
"""What the sheen is made of: what stands above, and airlight."""
RAIN_EXTINCTION_PER_M = 0.006
"""Haze of strong rain at rain code 1."""
RAIN_AIR = 0.8
"""Brightness of that haze, of the airlight."""
STREAKS = 0.11
"""Opacity of the streaks of rain 1."""
FOG_EXTINCTION_PER_M = 0.03
"""Extinction at fog code 1: a meteorological visibility of about 130 m (Koschmieder: 3.9 / extinction)."""
HAZE_GREY = 0.8
"""How far fog 1 or rain 1 takes the colour out of the airlight: drops scatter all colours alike."""
VEIL_BEND = 0.05
"""The display value about which the root that light is shown by bends, so that its slope stays finite at black."""
HAZE_CAP_M = 300.0
"""Haze is a layer on the ground: the sky is seen through this much of it."""


def mirror_reach(height: int) -> int:
    """Over how many rows of a picture of `height` rows a wet road smears what it mirrors: an odd number."""
    return max(3, (height // 12) | 1)
