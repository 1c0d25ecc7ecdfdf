"""What the vehicle says: samples, clocks, its recent past, recorded logs."""
