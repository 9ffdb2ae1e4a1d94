"""The measured dives of the Haizhe AUV: how they are read, and what explains their heave."""
