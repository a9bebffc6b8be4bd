"""The cart-poles."""
