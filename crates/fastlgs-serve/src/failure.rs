//! Error responses of the HTTP interface.

use axum::Json;
use axum::extract::rejection::{JsonRejection, PathRejection, QueryRejection};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde_json::json;

/// An error response: HTTP status and reason.
#[derive(Debug)]
pub struct Failure {
    status: StatusCode,
    reason: String,
}

impl Failure {
    /// Creates an error response; `reason` is one sentence.
    pub fn new(status: StatusCode, reason: impl Into<String>) -> Self {
        Self {
            status,
            reason: reason.into(),
        }
    }

    /// Returns status 503: too many requests are waiting or running.
    pub fn busy() -> Self {
        Self::new(
            StatusCode::SERVICE_UNAVAILABLE,
            "the server is busy; try again in a moment",
        )
    }

    /// Returns status 400: the request is invalid.
    pub fn bad_request(reason: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, reason)
    }
}

impl IntoResponse for Failure {
    fn into_response(self) -> Response {
        (self.status, Json(json!({ "error": self.reason }))).into_response()
    }
}

impl From<anyhow::Error> for Failure {
    fn from(error: anyhow::Error) -> Self {
        tracing::error!("{error:#}");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            fastlgs::one_sentence(error.as_ref()),
        )
    }
}

impl From<fastlgs_core::Error> for Failure {
    fn from(error: fastlgs_core::Error) -> Self {
        anyhow::Error::from(error).into()
    }
}

impl From<JsonRejection> for Failure {
    fn from(rejection: JsonRejection) -> Self {
        Self::new(rejection.status(), rejection.body_text())
    }
}

impl From<PathRejection> for Failure {
    fn from(rejection: PathRejection) -> Self {
        Self::new(rejection.status(), rejection.body_text())
    }
}

impl From<QueryRejection> for Failure {
    fn from(rejection: QueryRejection) -> Self {
        Self::new(rejection.status(), rejection.body_text())
    }
}

impl From<fastlgs::Error> for Failure {
    fn from(error: fastlgs::Error) -> Self {
        use fastlgs::Error::{Invalid, NotFound, Option};
        if matches!(error, Invalid(_) | NotFound(_) | Option { .. }) {
            return Self::bad_request(error.to_string());
        }
        anyhow::Error::from(error).into()
    }
}
