"""The camera model, from chessboards or from the flight itself."""
