"""The maths: NumPy arrays in and out, float64, leading batch axes. Knows no Gymnasium, MuJoCo or torch."""
