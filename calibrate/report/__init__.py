"""What every report page needs: templates, pictures as data, sealed JSON, shared sentences."""
