"""What decides: trained policies, classical and adversarial controllers, and the shield."""
