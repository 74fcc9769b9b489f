"""Phase 1: values of states (IQL), weights of segments, and the skills that the weighted trajectory VAE learns."""
