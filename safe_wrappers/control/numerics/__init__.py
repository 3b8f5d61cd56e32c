"""Series, polynomials, matrix exponentials, rotations, geometry, cone programs."""
