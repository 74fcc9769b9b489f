"""Tables, figures and the page of finished runs, made from their run folders; nothing here knows a learner."""
