"""Numbers that all ways to draw splats share: reference, kernels and headers."""

ALPHA_MIN = 1 / 255  # fainter contributions are skipped
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance drops below this
MEDIAN = 0.5  # transmittance at the median depth
LOG_ALPHA_SLACK = 0.01  # of the logarithm of ALPHA_MIN: keeps footprints on the safe side of float32 rounding
PIXEL_SLACK = 0.01  # pixels, of the test which tiles a footprint meets, for the same reason

TILE = 16  # pixels, width and height of a tile
SPLAT_SIZE = 16  # floats per splat
EXTRAS = 4  # numbers that splats may have beside a colour
ABSOLUTE = 10  # column of a gradient record where absolute gradients begin
RECORD_SIZE = ABSOLUTE + 2 + EXTRAS  # floats per gradient record
