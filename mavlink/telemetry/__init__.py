"""Vehicle telemetry: samples, clocks, recent history, recorded logs."""
