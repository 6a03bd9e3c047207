//! Who may ask: on the loopback any program of this machine that calls the server by a loopback name; elsewhere who knows the token.
//! And how much: at most so many requests at a time, of at most so many bytes.

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

/// Requests that are worked on at the same time; more are told to come back.
const AT_ONCE: usize = 64;
/// Largest body of a request, in bytes.
pub const LARGEST_BODY: usize = 8 << 20;
/// So much of a body is listened to; who sends more may not hear the answer.
const PATIENCE: usize = 64 << 20;
/// And so long.
const PATIENT_FOR: Duration = Duration::from_secs(60);

/// What every request is checked against.
pub struct Guard {
    loopback: bool,
    /// Names under which a proxy on this machine passes requests on.
    hosts: Vec<String>,
    /// Hexadecimal digits that requests must know; nothing on the loopback.
    pub token: Option<String>,
    places: Semaphore,
}

impl Guard {
    /// The guard of a server at `address`; with a new token unless that is the machine itself.
    pub fn new(address: SocketAddr, hosts: &[String]) -> anyhow::Result<Self> {
        let loopback = address.ip().is_loopback();
        let mut secret = [0u8; 16];
        // The one thing that must not follow from --seed.
        getrandom::fill(&mut secret).map_err(|e| anyhow::anyhow!("the system gives no random numbers for the token: {e}"))?;
        let token = (!loopback).then(|| secret.iter().map(|b| format!("{b:02x}")).collect());
        Ok(Self { loopback, hosts: hosts.to_vec(), token, places: Semaphore::new(AT_ONCE) })
    }

    /// Whether a request may pass. A foreign page that had its name resolve to this machine would send that name as host.
    fn refusal(&self, request: &Parts) -> Option<Failure> {
        if self.loopback {
            let host = request.headers.get(header::HOST).and_then(|h| h.to_str().ok()).unwrap_or_default();
            let name = host.rsplit_once(':').filter(|(_, port)| port.parse::<u16>().is_ok()).map_or(host, |(name, _)| name);
            let bare = name.trim_start_matches('[').trim_end_matches(']');
            let known = self.hosts.iter().any(|host| host.eq_ignore_ascii_case(bare));
            let own = known || bare == "localhost" || bare.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback());
            if !own {
                return Some(Failure::new(
                    StatusCode::FORBIDDEN,
                    format!(
                        "this server is not '{name}'; use its loopback address, or start it with --host-name {bare} behind a proxy of that name"
                    ),
                ));
            }
            // Browsers say whose page asks. One may lead here, and nothing more.
            let from = request.headers.get("sec-fetch-site").and_then(|h| h.to_str().ok()).unwrap_or_default();
            let foreign = matches!(from, "cross-site" | "same-site") && is_api(request);
            return foreign.then(|| Failure::new(StatusCode::FORBIDDEN, "pages of other sites may not ask this server"));
        }
        let wanted = self.token.as_deref()?;
        // The page itself holds no secret; it passes the token on with what it asks for.
        if !is_api(request) {
            return None;
        }
        let by_header = request.headers.get(header::AUTHORIZATION).and_then(|h| h.to_str().ok()).and_then(|h| h.strip_prefix("Bearer "));
        let by_query = request.uri.query().and_then(|q| q.split('&').find_map(|p| p.strip_prefix("token=")));
        // Every byte is looked at, so that time tells nothing about the first wrong one.
        let same = |given: &str| given.len() == wanted.len() && given.bytes().zip(wanted.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b)) == 0;
        let known = by_header.is_some_and(same) || by_query.is_some_and(same);
        (!known).then(|| Failure::new(StatusCode::UNAUTHORIZED, "the token is missing or wrong; open the address that the server printed"))
    }
}

/// Whether it asks for more than the page.
fn is_api(request: &Parts) -> bool {
    request.uri.path().starts_with("/api/")
}

/// The bytes of a body, or why it is not taken; what is more than `most` is listened to but not kept. An answer that is sent before
/// its request has arrived is lost to whoever is still sending.
async fn receive(mut body: Body, most: usize) -> Result<Vec<u8>, Failure> {
    let (mut kept, mut arrived) = (Vec::new(), 0);
    let listen = async {
        while let Some(frame) = body.frame().await {
            let data = frame.ok()?.into_data().unwrap_or_default();
            arrived += data.len();
            if arrived <= most {
                kept.extend_from_slice(&data);
            } else if arrived > PATIENCE {
                break;
            }
        }
        Some(())
    };
    match tokio::time::timeout(PATIENT_FOR, listen).await {
        Ok(Some(())) if arrived <= most => Ok(kept),
        Ok(Some(())) => Err(Failure::new(StatusCode::PAYLOAD_TOO_LARGE, format!("too large: at most {} MiB", LARGEST_BODY >> 20))),
        Ok(None) | Err(_) => Err(Failure::new(StatusCode::REQUEST_TIMEOUT, "the request did not arrive whole")),
    }
}

/// Checks a request, counts it, and adds what browsers need to know to every answer.
pub async fn check(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let (parts, body) = request.into_parts();
    // Who is refused takes no place, and the page, which everybody may have, needs none.
    let place = match guard.refusal(&parts) {
        Some(refusal) => Err(refusal),
        None if !is_api(&parts) => Ok(None),
        None => guard.places.try_acquire().map(Some).map_err(|_| Failure::busy()),
    };
    let body = receive(body, if matches!(place, Ok(Some(_))) { LARGEST_BODY } else { 0 }).await;
    let mut response = match (place, body) {
        (Err(refusal), _) | (Ok(_), Err(refusal)) => refusal.into_response(),
        (Ok(_place), Ok(body)) => next.run(Request::from_parts(parts, body.into())).await,
    };
    let policy = "default-src 'self'; img-src 'self' blob: data:; style-src 'self'; frame-ancestors 'none'; base-uri 'none'";
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}
