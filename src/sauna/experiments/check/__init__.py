"""`sauna check`: what is wrong with an environment, in words, and how it is mended."""
