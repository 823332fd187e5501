"""Press a Chinese brush with a robot arm, record it, and measure how well a stroke model predicts the ink."""
