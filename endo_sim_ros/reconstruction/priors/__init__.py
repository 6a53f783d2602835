"""Where depth comes from: sources, refinement between views, extrapolation beyond them."""
