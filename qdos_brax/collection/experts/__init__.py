"""Experts that collect data: trained walkers, and the steering that turns them into navigators and dribblers."""
