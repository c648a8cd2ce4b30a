"""Light of targets integrated over pixels: outlines, occlusion, sampled meshes."""
