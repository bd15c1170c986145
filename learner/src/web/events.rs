//! What is new, as server-sent events: the status each second, and the lines of `metrics.jsonl` from where the
//! page left off.

use super::Page;
use crate::coordinator::Control;
use axum::{
    extract::{Query, State},
    http::HeaderMap,
    response::sse::{Event, KeepAlive, Sse},
};
use rit_record::Line;
use serde::Deserialize;
use std::{convert::Infallible, time::Duration};
use tokio::sync::mpsc;
use tokio_stream::{Stream, wrappers::ReceiverStream};

/// From one status to the next.
const STATUS_EVERY: Duration = Duration::from_secs(1);

/// Events that may wait for a slow page.
const QUEUE: usize = 4;

#[derive(Deserialize)]
pub struct Since {
    /// A [`Position`] in words.
    since: Option<String>,
}

/// How far a page has read. Another learner may have cut the metrics off and gone on otherwise, so a position
/// counts with its own learner only.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Position {
    learner: u64,
    offset: u64,
}

impl Position {
    fn parse(text: &str) -> Option<Self> {
        let (learner, offset) = text.split_once('-')?;
        Some(Self { learner: learner.parse().ok()?, offset: offset.parse().ok()? })
    }
}

/// `reset`: forget all metrics. `metrics`: an array of lines. `status`: a `RunStatus`. `over`: the run is.
pub async fn events(
    State(page): State<Page>,
    Query(Since { since }): Query<Since>,
    headers: HeaderMap,
) -> Sse<impl Stream<Item = Result<Event, Infallible>>> {
    // A browser that connects again by itself says so in the header.
    let since = headers.get("last-event-id").and_then(|id| id.to_str().ok().map(str::to_owned)).or(since);
    let known =
        since.as_deref().and_then(Position::parse).filter(|position| position.learner == page.learner);
    let (sender, receiver) = mpsc::channel(QUEUE);
    tokio::spawn(async move {
        // Ends when the page has gone or the run is over.
        let _ = feed(&page, known, &sender).await;
    });
    Sse::new(ReceiverStream::new(receiver)).keep_alive(KeepAlive::default())
}

/// The page has gone.
struct Gone;

async fn feed(
    page: &Page,
    known: Option<Position>,
    sender: &mpsc::Sender<Result<Event, Infallible>>,
) -> Result<(), Gone> {
    let send = async |event: Event| sender.send(Ok(event)).await.map_err(|_| Gone);
    if known.is_none() {
        send(bare("reset")).await?;
    }
    let mut metrics = page.metrics.clone();
    metrics.begin_at(known.map_or(0, |position| position.offset));
    let mut ticks = tokio::time::interval(STATUS_EVERY);
    loop {
        // The end is told at once: soon after it no browser is there to tell.
        tokio::select! {
            _ = ticks.tick() => {}
            () = page.handle.over() => {}
        }
        let Ok(status) = page.handle.ask(Control::Status).await else {
            return send(bare("over")).await;
        };
        if let Ok(status) = Event::default().event("status").json_data(status) {
            send(status).await?;
        }
        loop {
            let mut reader = metrics.clone();
            let read = tokio::task::spawn_blocking(move || reader.read().map(|lines| (reader, lines))).await;
            let Ok(Ok((reader, lines))) = read else { break };
            metrics = reader;
            if lines.is_empty() {
                break;
            }
            let id = format!("{}-{}", page.learner, metrics.at());
            if let Ok(event) = Event::default().event("metrics").id(id).json_data(shown(lines)) {
                send(event).await?;
            }
        }
    }
}

/// What a page draws of lines: the means of evaluations, not each of their episodes.
fn shown(lines: Vec<Line>) -> Vec<Line> {
    lines.into_iter().map(Line::means).collect()
}

/// An event that says all by its name. Browsers pass one without data over.
fn bare(name: &str) -> Event {
    Event::default().event(name).data("null")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_are_read_or_forgotten() {
        assert_eq!(Position::parse("17-230"), Some(Position { learner: 17, offset: 230 }));
        for text in ["", "17", "17-", "-3", "a-b", "17-3-4"] {
            assert_eq!(Position::parse(text), None, "{text}");
        }
    }
}
