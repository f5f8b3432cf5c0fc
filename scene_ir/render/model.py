"""Constants of the renderer's models of texture lookup, daylight, paint, leaves and weather, for both backends.

The formulas are in `texture`, `reference` and `environment` in plain torch, and in `kernels`. A pair (low, high)
gives the bounds of a `texture.smoothstep`. Colours are RGB display values in [0, 1].
"""

from __future__ import annotations

import math

# --------------------------------------------------------------------------- what the photograph knows of a pixel

DEPTH_TOLERANCE_M = (0.25, 0.6)
"""A point this far behind the photographed surface starts to be, and is, unseen: thicker than a mirror or a seat.
"""
STRETCH = (1.0, 2.2)
"""Growth of the cosine towards the camera, relative to the photographed one, at which texels start to smear and at
which the completion looks better: stretched to two and three times their width.
"""
GRAZING = (0.06, 0.04)
"""Added to the photographed cosine of all but paint and of paint, which would be 0 at the outline. Tyres, arches
and trims are small and curved; stretched a little, they look better than templates with dark edges along the
mesh.
"""
SQUARED_COS = 1e-4
"""Added to the square of that cosine, so that it bends smoothly to 0 where the photograph saw the back."""
SQUARE = (0.15, 0.4)
"""Cosine towards the camera from which, and beyond which fully, a pixel is evidence of the finish: near the
outline, pixels mix with the background, and a slightly wrong mesh shows another part.
"""
OPEN_TURN = (0.02, 0.1)
"""Growth of that cosine over which half-transparent texels of the outline, now inside it, are filled."""
OPEN_ALPHA = (0.2, 0.5)
"""Opacity up to which those texels show the background, and from which they certainly show the vehicle."""
RIM = (0.3, 0.5)
"""Photographed cosine up to which a point is near the outline, and beyond which it is not."""
OUTLINE_TURN = (0.1, 0.25)
"""Change of that cosine at which a point starts to leave, and has left, the outline."""
OUTLINE_PX = (1.0, 2.2)
"""Distance inside the photographed mesh up to which texels belong to the outline, and beyond which to the inside.
"""
OUTER_OUTLINE_PX = (2.0, 3.0)
"""The same distance for a point that is at the outline now: up to the first value it was at the outline in the
photograph too and its surroundings move with it; beyond the second it was inside, and the photographed outline
would be a rim next to the vehicle. Two pixels, since a point looked up between pixel centres can be at the outline
and lie that far inside.
"""
MIRRORED_RIM = (0.0, 1.0)
"""Outline share of a texel from which, and beyond which fully, it no longer stands for the other side: an
outline's matte may include background, and such a pixel is stretched over many.
"""
MIRRORED_COS = (0.05, 0.2)
"""Photographed cosine of the other side from which, and beyond which fully, it stands for this one."""
LEAST_MIRRORED_ALPHA = 0.4
"""A texel of the other side is divided by its opacity, but by no less than this."""
HIDDEN_PX = (1.0, 3.0)
"""Distance inside a nearer object's matte at which texels start to be, and are, unknown."""
SOLID_ALPHA = (0.5, 0.95)
"""Opacity from which, and beyond which fully, a texel may stand for other places."""
SUPPORTED = (0.1, 0.9)
"""Support of a texel up to which, and beyond which no longer, the photograph shows that there is no vehicle."""
BORDER_PX = (0.5, 1.5)
"""Distance beyond the photograph's border over which its content ends."""
EXTENDED_PX = (2.0, 14.0)
"""Distance beyond the border over which a vehicle's appearance at the border gives way to its other side or
template: a soft change is less visible than a seam, and farther out the border's pixels become bars.
"""
SHADOW_EXTENDED_PX = (4.0, 60.0)
"""The same for its shadow, which has no other side and is smooth."""
SUPPORT_PX = 2
"""Farther than this beyond the matte, the photograph shows that there is no vehicle."""
COVERED = (0.5, 1.0)
"""Coverage up to which a pixel at the outline takes its neighbours' values, and from which its own."""
LEAST_NEIGHBOUR = 1e-3
"""Weight of a neighbour that is hardly covered itself."""
SATURATED = 1e-6
"""A colour this near to 0 or 1 is at the bound: rounding decides on which side."""
FAR_AWAY_PX = 1e5
"""Lookup position of points that were behind the camera."""
SUBPIXELS = ((0, 0), (1, -3), (-1, 3), (5, 1), (-3, -5), (-5, 5), (-7, -1), (3, 7), (7, -7))
"""Positions within a pixel, in sixteenths, over which mesh attributes are averaged: trims thinner than a pixel
would be rows of dots. The centre, and eight positions of which no two share a row or a column (Direct3D's).
"""
WALK = 8
"""Most faces that a walk over the mesh passes to such a position."""
NEAREST_MIRRORED_M = 0.1
"""Points of the other side closer to the camera plane than this are looked up at this distance."""

# ------------------------------------------------------------------------------------------------------- daylight

GROUND_RGB, HORIZON_RGB, ZENITH_RGB = (0.30, 0.29, 0.28), (0.46, 0.47, 0.47), (0.52, 0.66, 0.86)
"""What surfaces mirror. Houses, hedges and other cars stand at their level, not the sky."""
ZENITH_UP, HORIZON_UP = (0.0, 0.9), (-0.08, 0.12)
"""Upward component of a mirrored ray where horizon turns to zenith, and ground to horizon."""
AMBIENT = (0.30, 0.38)
"""Light from all around, and what the sky adds to a surface that faces up; display values, as all here."""
SUNLIGHT = 0.62
"""Light of the sun on a surface that faces it, on a clear day with some haze."""
TERMINATOR = 0.01
"""Added to the square of the sun's cosine: light ends softly where a surface turns away."""
OCCLUDED = (0.45, -0.05, 0.4)
"""Remaining light at a vehicle's foot; the heights, as shares of its own, between which it grows to full."""
FRESNEL = 0.04
"""Share of light that a surface mirrors at normal incidence (Schlick's approximation)."""
PAINT_MIRRORS = 0.55
GLASS_MIRRORS = (0.10, 0.75)
"""Glass: constant share, and factor of the Fresnel share."""
GLINT = (0.35, 0.5)
"""The sun's highlight on paint and on glass, a cosine to the power of 40."""
RELIT = (0.3, 0.6)
"""Share of a change of light that a photographed colour follows, of all but paint and of paint: glass and rubber
show less of it, and the sun may be behind a tree. Measured against generated ground truth.
"""
SUN_TURN_RAD, SUN_RISE_RAD, SUN_STRENGTH = math.radians(15.0), math.radians(7.5), 0.2
"""Light code 1: turn of the sun about the vertical, its rise, and the relative gain of its strength."""
SUN_OFFSET_MAX_M = 4.0
"""Longest cast shadow: beyond it the penumbra of a low sun is too faint to be worth its pixels."""
LEAST_SINE = 0.3
"""Least sine of the sun's height: lower suns cast shadows as this one does."""
SHRUNK = 0.02
"""Share of a vehicle's size within which its shadow softly stops to shrink with the vehicle."""
OWN_SHADOW = 0.9
"""Cosine similarity of a photographed shadow and that of the vehicle's box from which it is the vehicle's own."""
RELIT_MOST = 0.5
"""Largest share by which a photographed colour brightens or darkens as its surface turns."""

# ---------------------------------------------------------------------------------------------------------- paint

LIGHTNESS_GAIN, CHROMA_GAIN, GLOSS_GAIN, DIRT_GAIN = 2.2, 45.0, 0.9, 0.55
"""Texture code 1: change of the logit of L*, of a* and b*, of contrast about the paint's L*; opacity of dust."""
GLOSSY_L = 30.0
"""Difference of L* that gloss counts as 1."""
CLEAN_ROOF = 0.75
"""Share of the dust that does not stick to the roof."""
DUST_RGB = (0.47, 0.42, 0.35)
"""Dry road dust."""
WAIST = (0.51, 0.55)
"""Shares of a person's height between which the codes of the clothes below and above the waist blend: about the hip
joint, at 0.53 (Drillis and Contini 1966, in Winter, Biomechanics and Motor Control of Human Movement, figure 4.1)."""
LEVEL = (0.01, 0.99)
"""Bounds of L* / 100 before its logit is taken."""
GAMUT_SHARPNESS = 20.0
"""Colours bend within about 1 / 20 of black and white."""
LEAST_ALPHA = 0.02
"""A premultiplied colour is divided by its opacity, but by no less than this, before it is repainted."""

# --------------------------------------------------------------------------------------------------------- leaves

FEWEST_LEAVES = 0.004
"""Foliage share below which a pixel stays unchanged: one step of an 8-bit picture."""
LEAF_LIGHTNESS = 1.5
"""Lightness code 1: change of the logit of L*."""
LEAF_CHROMA = 0.3
"""Hue code 1: relative gain of chroma."""
LEAF_TURN, LEAF_TURN_MORE, LEAF_TURN_BEND = 0.70, 0.35, 2.0
"""Turn of the hue in rad per hue: constant part, factor and bend of tanh(`LEAF_TURN_BEND` code). Green is nearer
to blue than to orange.
"""
LEAF_RED, LEAF_YELLOW = 10.0, 8.0
"""Hue code 1: shift of a* and b* of a middle grey."""
CROWN_BEND = 6.0
"""How sharply density 0 separates thicker crowns from thinner ones."""
THICK_SHARE, THICK_DARKNESS, THIN_SHARE = 0.5, 0.25, 0.8
"""Thickest crown: share that is deep inside, and brightness there; how far the thinnest crown opens."""

GRASS_M = 0.3
"""Height above the ground from which foliage is a crown, which density changes; below it fades into grass."""

# -------------------------------------------------------------------------------------------------------- weather

LUMA = (0.299, 0.587, 0.114)
"""ITU-R BT.601."""
SKY_RGB = (0.78, 0.82, 0.87)
"""Colour of the air where the photograph shows no sky."""
SHADOW_SOFTENING = (0.5, 0.4, 0.5, 0.6, 2.0, 0.6)
"""Rates at which fog, rain, time, overcast, night and snow weaken cast shadows."""
CLOSED_SKY_LOG = 1.5
"""Bound of the logarithm of what a closed sky changes: no pixel becomes more than 4.5 times as bright, or as dark."""
CLOSED_SKY_OFFSET = 0.02
"""Added to display values before their logarithm is taken."""
CLOSED_SKY_RELIT = (-0.6, 1.0)
"""Bounds of the brightening of a vehicle's surface under a closed sky."""
CLOSED_SKY_BURNT = (0.9, 1.0)
"""Highest channel of a pixel from which, and at which, it has lost its colour: there all channels change alike."""
CLOSED_SKY_RADIUS, CLOSED_SKY_EDGE = 0.02, 2e-3
"""Guided filter: radius as a share of the focal length, and the variance of the logarithm from which an edge is one.
"""
OVERCAST = 0.85
"""Weight of the picture under a closed cover at overcast 1."""
OVERCAST_COLOUR, OVERCAST_CONTRAST = 0.70, 0.94
"""Remaining colour and contrast."""
OVERCAST_FROM, OVERCAST_TO = 0.42, 0.42
"""Display value about which contrast shrinks, and its value afterwards."""
COVER_AIR, COVER_LIGHT, COVER_STRUCTURE = 0.45, 0.62, 0.15
"""The cloud cover: share of the grey airlight, light of its own, and remaining structure of the sky."""
OVERCAST_AIR = 1.05
"""Brightness of the airlight under it, relative to the grey one."""
DARKENING = (0.36, 0.32, 0.24)
"""Optical depth of red, green and blue at time code 1 in display values, after the camera's exposure: the end of civil
twilight, bluer and somewhat darker, as a dashcam exposes longer.
"""
TWILIGHT_SKY = (0.62, 0.48, 0.26)
"""What it adds to the sky's gain: the glow of twilight lights the sky more than the ground."""
WARMTH = (0.70, 0.12, -0.42)
"""What dusk, at half the time code, adds to red, green and blue."""
DUSK_ENDS, DIMMING, DIMMING_ENDS = 3.5, 0.25, 2.0
"""Rates in the square of the code at which that warmth and an early dimming end, and the strength of the dimming.
"""
DAMP = 0.9
"""Weight of the wet picture at rain 1."""
DAMP_LIGHT, DAMP_COLOUR = 0.92, 1.0
"""Remaining light and colour in it."""
WET_ROAD = 0.60
"""Remaining light of a wet road's own colour."""
WATER, FILM = 0.04, 0.9
"""Share of light that water mirrors at normal incidence (Schlick's approximation), and how far a wet road is covered
by water.
"""
SHEEN_MIRROR, SHEEN_AIR = 0.85, 0.15
"""Parts of what a wet road mirrors: the smeared picture, and light from all around."""
MIRROR_ROWS, MIRROR_REACH, MIRROR_SLACK = 125, 0.07, 0.05
"""Rows of the mirrored picture; share of them over which the road smears it, twice; slack of the search for what a ray
meets, relative to its slope.
"""
RAIN_EXTINCTION_PER_M = 0.002
"""Haze of strong rain at rain code 1."""
RAIN_AIR = 1.15
"""Brightness of that haze, relative to the airlight."""
STREAKS = 0.06
"""Opacity of the streaks of rain 1."""
SPRAY_PER_M, SPRAY_BEHIND, SPRAY_SIZE = 0.10, 0.3, (1.0, 0.28, 0.36)
"""Spray of vehicles: extinction in its middle at rain 1; distance of that behind the vehicle's end, in its widths;
standard deviations along, up and across, in widths, heights and widths of the vehicle.
"""
SPRAY_REACH, SPRAY_NEAR_M, SPRAY_LOGIT = 3.0, (3.0, 7.0), 1.7
"""Standard deviations beyond which there is none; depth of its middle from which it is drawn, and fully; slope of the
logistic function that stands for the normal distribution.
"""
DROPS, DROP_RADII, DROP_HANGS = 70, (0.006, 0.024), 0.15
"""Drops on the windscreen at amount 1, their least and largest radius in heights of the picture, and how much wider
they are below.
"""
DROP_FIELD, DROP_ROWS, DROP_EDGE, DROP_GROWS = 0.16, 40, 0.5, 0.1
"""What a drop shows: distance from its middle per radius, in heights of the picture, in its middle, and twice as much
at its edge; rows of that picture, which is out of focus; width of the soft edge, in radii; amount over which a drop
appears.
"""
SNOW_FOG, SNOW_COVER = 0.08, 0.9
"""Haze and clouds of snow 1, as codes of fog and overcast."""
SLUSH, SLUSH_LIGHT = 0.18, 0.80
"""How far the road of snow 1 turns towards a brightness."""
FLAKE_M, FLAKES = (1.2, 3.6, 10.8), (240, 5000, 20000)
"""Distances from which, to three times of which, layers of flakes fall, and the flakes of each in a square picture."""
FLAKE_RADIUS_M, FLAKE_BLUR_M, FLAKE_LEAST_PX = 0.003, 0.002, 0.5
"""Radius of a flake, its blur out of focus, and the least radius in the picture; standard deviations."""
FLAKE_OPACITY, FLAKE_LIGHT = 3.0, 1.05
"""Opacity of flakes before they are drawn out, and their light relative to the airlight's."""
FLAKE_DRIVE_M, FLAKE_FALL_M, FLAKE_FOCAL = 0.06, 0.012, 0.7
"""Way of the camera and of flakes during the exposure; focal length, in widths of the picture."""
FOG_EXTINCTION_PER_M = 0.03
"""Extinction at fog code 1: a meteorological visibility of about 130 m (Koschmieder: 3.9 / extinction)."""
HAZE_GREY = 1.0
"""How far fog 1 or rain 1 removes the airlight's colour: drops scatter all colours alike."""
VEIL_BEND = 0.05
"""Display value about which the root that converts light to display values bends, so that its slope stays finite
at black.
"""
HAZE_CAP_M = 300.0
"""Haze is a layer on the ground: the sky is seen through this much of it."""

# ---------------------------------------------------------------------------------------------------------- night

NIGHTFALL = 4.0
"""Rate at which the share of night grows with its code: light falls by about equal factors."""
STREET_RGB, STREET_BASE = (0.31, 0.21, 0.13), 0.06
"""Light of street lamps relative to daylight, after the camera's exposure, in the middle of their pools; its share
between them.
"""
ROAD_LIGHT, EXPOSURE = 0.13, (0.4, 1.2)
"""Light of a photographed road that the headlamps' light is for; it changes in inverse proportion to it, within bounds,
as a camera's exposure by night does not depend on that by day.
"""
BY_DAY = (0.07, 0.12)
"""Mean light of a photograph that is taken by night, which the code hardly changes, and of one by day."""
STREET_LAMP_M, STREET_ASIDE_M, STREET_EVERY_M, STREET_FAR_M, STREET_VISIBLE_M = 8.0, 7.0, 36.0, 320.0, 50.0
"""Height of street lamps; their distance from the camera's path, alternately left and right; distance along it on
each side, and of the farthest; distance from which they are visible: a nearer one would hang in the sky, for want of
a post.
"""
STREET_LAMP_RGB, STREET_LAMP_AT_10_M = (1.0, 0.80, 0.52), 7.0
"""Colour of a street lamp, and the radius of its image in px at 10 m and 720 lines."""
HOUSE_LAMPS_M, HOUSE_ASIDE_M, HOUSE_LAMP_HEIGHT_M = (24.0, 210.0, 1.8), (5.5, 14.0), (3.6, 6.5)
"""Lamps at houses and crossings: first and last distance along the street and that between two; distance from the
camera's path; height, above what a car hides.
"""
HOUSE_LAMP_RGB = ((1.0, 0.80, 0.50), (1.0, 0.95, 0.85), (0.9, 0.97, 1.0), (0.15, 0.95, 0.55), (1.0, 0.12, 0.08))
"""Their colours: lamps, windows, signs, traffic lights."""
LAMP_SHOWS = 0.9
"""Depth, relative to a lamp's, up to which a surface hides it: depths of a street's sides are estimates."""
GLOW_RGB = (0.0050, 0.0042, 0.0039)
"""Light of the sky over a town, at the horizon."""
GLOW_HEIGHT = 0.6
"""Share of the picture's height over which that glow falls by a factor e."""
HEAD_RGB, HEAD_FAR_M = (1.30, 1.07, 0.85), 24.0
"""Light of the own headlamps, relative to daylight, on what is near; distance at which it has fallen to half."""
SUN_SOFTENED = 0.2
"""Compression of daylight before street lamps replace it: sunlit surfaces come closer to those in the shade."""
RETRO_WHITE = 1.5
"""Growth of the headlamps' light on the brightest surfaces: road markings and number plates send light back."""
HEAD_AIM, HEAD_SIDE = 0.32, 0.12
"""Width of the beam, as a tangent, and its share far aside."""
HEAD_CUT_M, HEAD_SOFT_M, HEAD_ABOVE = 0.9, 0.25, 0.15
"""Height above the ground at which the beam is cut off, width of that edge, and share of the light above it."""
RETRO, RETRO_CHROMA = 5.0, (0.30, 0.45)
"""Gain of the headlamps on signs, which send light back, and the chroma from which an area may be one, and is."""
LIT_LEVEL, LIT_CONTRAST, LIT_GAIN = (0.80, 0.95), (0.15, 0.35), 1.6
"""Brightness, and brightness over what surrounds it, from which a small area may be a lamp, and is; gain of its
light, as the camera opens.
"""
LIT_HEIGHT_M = (1.0, 1.5)
"""Height above the ground from which it may be one, and is: sunlit patches on the ground are none."""
GLARE = ((0.004, 0.5), (0.012, 0.3), (0.06, 0.08))
"""Glare of lamps: standard deviations, in heights of the picture, and shares of their light."""
LIT_MIRROR = 12.0
"""Light of lamps that a wet road mirrors, relative to that of their images, which are clipped."""
GLARE_FOG, GLARE_RAIN = 1.5, 0.6
"""Relative growth of glare at fog 1 and rain 1."""
CORNER = 0.45
"""Loss of light at the picture's corners, with the lens wide open."""
NOISE, NOISE_LEVEL = 0.0006, 0.012
"""Standard deviation of the noise at black, and its growth with the display value."""
EGO_DARKENED = 0.85
"""Share of its display values that the ego vehicle, inside of which no lamp shines, loses by night."""
NIGHT_BEND = 0.02
"""Display value about which the root that converts night's light to display values bends."""

# --------------------------------------------------------------------------------------------------------- lamps

LAMPS_ON = (1.6, 1.2, 1.6, 0.3, 3.0, 1.2)
"""Rates at which fog, rain, time, overcast, night and snow make drivers switch on their lamps."""
TAIL_LAMP_RGB, HEADLAMP_RGB = (3.2, 0.12, 0.08), (8.0, 7.2, 6.0)
"""Light of a lamp that faces the camera by night; white is 1."""
RIDER_LAMPS_M, RIDER_LAMP_RADIUS_M = (0.9, 0.6), 0.03
"""Heights of a bicycle's or motorcycle's lamps, front and rear (StVZO section 67 has 0.4 to 1.2 m and 0.25 to 1.2 m),
and their radius, like that of a vehicle's."""
TAIL_CORE = 0.25
"""Share of its red that the sensor shows as white in the middle of a tail lamp, where it overflows."""
LAMP_STRETCH = (1.5, 0.7)
"""Width and height of a lamp, relative to its radius."""
BRAKE_LAMP, LAMP_BEND = 2.5, 6.0
"""Light of a brake lamp, relative to a tail lamp's; how sharply lamps code 0 separates off from braking."""
LAMP_BY_DAY, LAMP_EXPOSURE = 0.08, (0.15, 0.12, 0.3, 0.05, 4.0, 0.1)
"""The same by daylight, where the exposure is shorter; rates at which fog, rain, time, overcast, night and snow make it
longer.
"""
LAMP_RADIUS_M, LAMP_LEAST_PX = 0.08, 0.7
"""Radius of a lamp, as the standard deviation of a Gaussian; least such width in the picture."""
LAMP_FACES = (-0.05, 0.35)
"""Cosine of a lamp's axis to the direction to the camera from which it shows, and shows fully."""
HEADLAMP_WIDE = 0.15
"""Share of a headlamp's light outside of its beam."""
STREAK, STREAK_SHARE = (0.05, 0.0015), 0.02
"""Widths of the streak across a lamp, in heights of the picture, and its share of the light."""
DRY_MIRROR, WET_MIRROR, MIRROR_LENGTH, MIRROR_WIDTH = 0.006, 0.2, 0.35, 1.8
"""Brightness of a lamp's image in a dry road, and in a wet one of what it mirrors; length of that image, in distances
from the lamp, and its width, in widths of the lamp.
"""
LAMP_SEARCH = 0.14
"""Reach of the search for the photograph's own lamp, in widths of the vehicle."""
TAIL_LAMP_RED, HEADLAMP_WHITE = (0.12, 0.25), (0.70, 0.85)
"""Excess of red, and least channel, from which a pixel may be, and is, a tail lamp or a headlamp."""
RED_LAMPS = (0.06, 2.5)
"""Share of red around lamps from which they are tail lamps, and how much more that is than on the whole vehicle."""
DRIVEN_ROAD, DRIVEN_ALONG = (0.35, 0.75), (0.65, 0.8)
"""Share of road beyond a vehicle's outer side from which it may drive, and does; the same of the cosine between its
heading and the camera's path.
"""
NEXT_LANE_M = 4.4
"""Distance from the camera's path within which an oncoming vehicle drives."""
