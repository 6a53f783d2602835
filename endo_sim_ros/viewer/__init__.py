"""The page on which tissue is seen in a browser and pulled with the mouse: `viewer.Viewer`."""
