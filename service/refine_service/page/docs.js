// Swagger UI on the service's own description.
SwaggerUIBundle({ url: "openapi.json", dom_id: "#api", deepLinking: true });
