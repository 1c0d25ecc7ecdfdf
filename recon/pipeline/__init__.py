"""Figure 1 of the paper: images in, posed depth images out."""
