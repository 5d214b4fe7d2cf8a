"""What can be wrong with a pixel of a rendered plane: one bit each."""

NORMAL_MISSING = 1  # the normal is zero, not finite or not of unit length: the pixel is 0
COLOUR_MISSING = 2  # a colour coefficient is not finite: the pixel is 0
TURNED_AWAY = 4  # n . v <= 0: the facet cannot be seen from here; its diffuse light is shown, its gloss is not
BACKGROUND = 8  # the ray misses the painting
OVERFLOW = 16  # the value is outside the range of float32: the pixel is 0

UNUSABLE = NORMAL_MISSING | COLOUR_MISSING | OVERFLOW  # the pixel is 0
