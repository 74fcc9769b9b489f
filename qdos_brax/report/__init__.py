"""Pictures and tables made from run folders; nothing here knows a learner."""
