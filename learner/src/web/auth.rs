//! Who gets in. Everything but `/healthz` needs the run's token, as a bearer or by the cookie that the address
//! with the token sets. What changes something must also come from the page itself.

use super::api::ApiError;
use axum::{
    extract::{Query, Request, State},
    http::{HeaderMap, Method, StatusCode, header, uri::Authority},
    middleware::Next,
    response::{Html, IntoResponse as _, Redirect, Response},
};
use rit_config::RunDir;
use rit_proto::transport::{Place, is_secret};
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use std::{net::IpAddr, sync::Arc};

/// What callers must know.
pub struct Gate {
    bearer: String,
    /// Browsers send cookies to all ports of a host: its name holds this run's apart from another's.
    cookie: String,
    /// What the cookie holds. It follows from the token and does not tell it, and a restarted learner knows it again.
    session: String,
    home: Home,
}

/// What callers that are let in see at `/`.
#[derive(Clone, Copy, Debug)]
pub enum Home {
    /// This page.
    Page(&'static str),
    /// What lies at this path.
    Path(&'static str),
}

impl Gate {
    /// Of this run's token.
    pub(super) fn of_run(run_dir: &RunDir) -> Self {
        Self::new(run_dir.token(), &run_dir.run_id()[..4], Home::Page(include_str!("assets/index.html")))
    }

    /// For those who know this token; the name keeps its cookie apart from those of other servers of this host.
    pub fn new(token: &str, name: &[u8], home: Home) -> Self {
        let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
        let session = hex(&Sha256::digest(format!("rit web session {token}")));
        Self { bearer: format!("Bearer {token}"), cookie: format!("rit-{}", hex(name)), session, home }
    }

    fn lets_in(&self, headers: &HeaderMap) -> bool {
        let bearer = headers.get(header::AUTHORIZATION);
        let cookies = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
        let mut cookies =
            cookies.flat_map(|text| text.split(';')).filter_map(|pair| pair.trim().split_once('='));
        bearer.is_some_and(|bearer| is_secret(bearer.as_bytes(), self.bearer.as_bytes()))
            || cookies.any(|(name, value)| {
                name == self.cookie && is_secret(value.as_bytes(), self.session.as_bytes())
            })
    }
}

/// What `/` may carry.
#[derive(Deserialize)]
pub struct Entry {
    token: Option<String>,
}

/// `/`: the page for browsers with the cookie; the cookie for those with the token, which then leaves the
/// address bar.
pub async fn enter(
    State(gate): State<Arc<Gate>>,
    Query(entry): Query<Entry>,
    headers: HeaderMap,
) -> Response {
    let Gate { bearer, cookie, session, home } = gate.as_ref();
    match entry.token {
        Some(token) if is_secret(format!("Bearer {token}").as_bytes(), bearer.as_bytes()) => {
            let cookie = format!("{cookie}={session}; Path=/; HttpOnly; SameSite=Strict");
            ([(header::SET_COOKIE, cookie)], Redirect::to("/")).into_response()
        }
        None if gate.lets_in(&headers) => match home {
            Home::Page(page) => Html(*page).into_response(),
            Home::Path(path) => Redirect::to(path).into_response(),
        },
        _ => (StatusCode::UNAUTHORIZED, Html(include_str!("assets/locked.html"))).into_response(),
    }
}

/// Refuses a `Host` that is no loopback name: DNS rebinding.
pub async fn only_to_loopback(request: Request, next: Next) -> Response {
    if host(request.headers()).is_some_and(|host| is_loopback(&host)) {
        next.run(request).await
    } else {
        ApiError::Forbidden("the Host of a request must be localhost, 127.0.0.1 or [::1]").into_response()
    }
}

/// Refuses callers that do not know the token; and requests that change something, unless the page itself sends them.
pub async fn only_with_token(State(gate): State<Arc<Gate>>, request: Request, next: Next) -> Response {
    if !gate.lets_in(request.headers()) {
        return ApiError::Unauthorized.into_response();
    }
    if let Some(place) = request.extensions().get::<Place>()
        && let Err(all_taken) = place.make_known()
    {
        return ApiError::AllTaken(all_taken).into_response();
    }
    if *request.method() != Method::GET && *request.method() != Method::HEAD && !is_own(request.headers()) {
        return ApiError::Forbidden("the Origin of a request that changes something must be this server")
            .into_response();
    }
    next.run(request).await
}

fn host(headers: &HeaderMap) -> Option<Authority> {
    headers.get(header::HOST)?.to_str().ok()?.parse().ok()
}

fn is_loopback(host: &Authority) -> bool {
    let name = host.host().trim_start_matches('[').trim_end_matches(']');
    name == "localhost" || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

fn is_own(headers: &HeaderMap) -> bool {
    let origin = headers.get(header::ORIGIN).and_then(|origin| origin.to_str().ok()?.strip_prefix("http://"));
    let origin = origin.and_then(|origin| origin.parse::<Authority>().ok());
    origin.is_some() && origin == host(headers)
}
