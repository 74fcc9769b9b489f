"""The member axis: seeds and hyperparameter values trained by one program, their health, and their memory."""
