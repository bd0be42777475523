// Description of the interface: Swagger UI on the service's own OpenAPI description.

SwaggerUIBundle({
  url: "openapi.json", // beside this page, `/api/v1/docs`
  dom_id: "#swagger-ui",
  deepLinking: true,
  validatorUrl: null, // by default a badge of another host
  docExpansion: "none",
  requestSnippetsEnabled: true,
  syntaxHighlight: false,
});
