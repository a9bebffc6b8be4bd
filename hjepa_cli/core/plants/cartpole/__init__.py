"""The cart-poles have a simulation, a teacher and a camera of their own."""
