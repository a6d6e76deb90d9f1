"""What users would pick instead, beside the package."""
