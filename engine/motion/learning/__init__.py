"""Learning of a patient's motion model: training set, fit, reference transfer and match with the patient."""
