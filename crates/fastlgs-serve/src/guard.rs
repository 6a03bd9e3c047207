//! Access control and limits of the HTTP interface.
//!
//! On a loopback address, a request must use a loopback host name. On other addresses, requests to
//! `/api/` need the token. The number of simultaneous requests and their size are limited.

use crate::failure::Failure;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use http_body_util::BodyExt;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Semaphore;

/// Largest number of simultaneous requests to `/api/`; further ones get status 503.
const MAX_CONCURRENT: usize = 64;
/// Largest body of a request, in bytes.
pub const MAX_BODY_BYTES: usize = 8 << 20;
/// Number of bytes that are read from a body that is too large. A client that sends more may not
/// receive the response.
const MAX_DISCARDED_BODY: usize = 64 << 20;
/// Longest time for reading a body.
const BODY_TIMEOUT: Duration = Duration::from_secs(60);

/// Access rules and limits that every request is checked against.
pub struct Guard {
    loopback: bool,
    /// Host names of proxies on this machine.
    hosts: Vec<String>,
    /// Token that requests must contain: 32 hexadecimal digits. `None` on a loopback address.
    pub token: Option<String>,
    permits: Semaphore,
}

impl Guard {
    /// Creates the guard of a server at `address`, with a new token unless it is a loopback
    /// address.
    ///
    /// # Errors
    /// The system provides no random numbers.
    pub fn new(address: SocketAddr, hosts: &[String]) -> anyhow::Result<Self> {
        let loopback = address.ip().is_loopback();
        let mut secret = [0u8; 16];
        // The token must be unpredictable, so it does not depend on --seed.
        getrandom::fill(&mut secret).map_err(|e| {
            anyhow::anyhow!("the system provides no random numbers for the token: {e}")
        })?;
        let token = (!loopback).then(|| secret.iter().map(|b| format!("{b:02x}")).collect());
        Ok(Self {
            loopback,
            hosts: hosts.to_vec(),
            token,
            permits: Semaphore::new(MAX_CONCURRENT),
        })
    }

    /// Returns the reason to refuse a request, or `None` if it may pass.
    ///
    /// The check of the host name stops DNS rebinding: a foreign page whose name resolves to this
    /// machine sends that name as host.
    fn refusal(&self, request: &Parts) -> Option<Failure> {
        if self.loopback {
            return self.loopback_refusal(request);
        }
        let wanted = self.token.as_deref()?;
        // The page itself is not secret. Its requests to the interface contain the token.
        if !is_api(request) {
            return None;
        }
        let by_header = header_text(request, &header::AUTHORIZATION).strip_prefix("Bearer ");
        let by_query = request
            .uri
            .query()
            .and_then(|q| q.split('&').find_map(|p| p.strip_prefix("token=")));
        // Compares all bytes, so that the time reveals nothing about the token.
        let same = |given: &str| {
            let pairs = given.bytes().zip(wanted.bytes());
            given.len() == wanted.len() && pairs.fold(0, |sum, (a, b)| sum | (a ^ b)) == 0
        };
        let known = by_header.is_some_and(same) || by_query.is_some_and(same);
        (!known).then(|| {
            Failure::new(
                StatusCode::UNAUTHORIZED,
                "the token is missing or wrong; open the address that the server printed",
            )
        })
    }

    /// Refuses requests to a local server that other sites send, or that use a foreign host name.
    fn loopback_refusal(&self, request: &Parts) -> Option<Failure> {
        let host = header_text(request, &header::HOST);
        let name = host
            .rsplit_once(':')
            .filter(|(_, port)| port.parse::<u16>().is_ok())
            .map_or(host, |(name, _)| name);
        let bare = name.trim_start_matches('[').trim_end_matches(']');
        let mut hosts = self.hosts.iter();
        let own = hosts.any(|host| host.eq_ignore_ascii_case(bare))
            || bare == "localhost"
            || bare.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback());
        if !own {
            return Some(Failure::new(
                StatusCode::FORBIDDEN,
                format!(
                    "this server does not accept the host name '{name}'; use its loopback address, or set the option host_name to {bare} if that is a proxy"
                ),
            ));
        }
        // Browsers report which site sends a request. Other sites may link to the page, but not use
        // the interface.
        let from = header_text(request, "sec-fetch-site");
        let foreign = matches!(from, "cross-site" | "same-site") && is_api(request);
        foreign.then(|| {
            Failure::new(
                StatusCode::FORBIDDEN,
                "pages of other sites may not use this server",
            )
        })
    }
}

/// Returns the text of a header; empty if it is missing.
fn header_text(request: &Parts, name: impl header::AsHeaderName) -> &str {
    let value = request.headers.get(name);
    value
        .and_then(|value| value.to_str().ok())
        .unwrap_or_default()
}

/// Returns whether a request is for the interface, not for a file of the page.
fn is_api(request: &Parts) -> bool {
    request.uri.path().starts_with("/api/")
}

/// Reads a body of at most `max_bytes` bytes.
///
/// A longer body is read but not kept, up to a limit: a client that is still sending would lose an
/// early response.
///
/// # Errors
/// Status 413 if the body is too large, 408 if it does not arrive completely or in time.
async fn read_body(mut body: Body, max_bytes: usize) -> Result<Vec<u8>, Failure> {
    let (mut kept, mut arrived) = (Vec::new(), 0);
    let read = async {
        while let Some(frame) = body.frame().await {
            let data = frame.ok()?.into_data().unwrap_or_default();
            arrived += data.len();
            if arrived <= max_bytes {
                kept.extend_from_slice(&data);
            } else if arrived > MAX_DISCARDED_BODY {
                break;
            }
        }
        Some(())
    };
    match tokio::time::timeout(BODY_TIMEOUT, read).await {
        Ok(Some(())) if arrived <= max_bytes => Ok(kept),
        Ok(Some(())) => Err(Failure::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            format!(
                "the request is too large: at most {} MiB are allowed",
                MAX_BODY_BYTES >> 20
            ),
        )),
        Ok(None) | Err(_) => Err(Failure::new(
            StatusCode::REQUEST_TIMEOUT,
            "the request did not arrive completely",
        )),
    }
}

/// Checks a request, limits simultaneous requests, and adds security headers to every response.
pub async fn check(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let (parts, body) = request.into_parts();
    // Refused requests and files of the page do not count towards the limit.
    let permit = match guard.refusal(&parts) {
        Some(refusal) => Err(refusal),
        None if !is_api(&parts) => Ok(None),
        None => guard
            .permits
            .try_acquire()
            .map(Some)
            .map_err(|_| Failure::busy()),
    };
    let body = read_body(
        body,
        if matches!(permit, Ok(Some(_))) {
            MAX_BODY_BYTES
        } else {
            0
        },
    )
    .await;
    let mut response = match (permit, body) {
        (Err(refusal), _) | (Ok(_), Err(refusal)) => refusal.into_response(),
        (Ok(_place), Ok(body)) => next.run(Request::from_parts(parts, body.into())).await,
    };
    let policy = "default-src 'self'; img-src 'self' blob: data:; style-src 'self'; frame-ancestors 'none'; base-uri 'none'";
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ] {
        response
            .headers_mut()
            .insert(name, HeaderValue::from_static(value));
    }
    response
}
