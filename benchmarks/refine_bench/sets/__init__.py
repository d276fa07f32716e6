"""The data sets: each module lists the cases of one published layout, or makes its own."""
