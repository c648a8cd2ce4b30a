"""Light to grey values: noise, quantisation, defects, background (EMVA 1288)."""
