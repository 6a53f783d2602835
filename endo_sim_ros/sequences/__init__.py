"""What goes in: recordings of every layout, bags, and the synthetic phantom, as posed frames."""
