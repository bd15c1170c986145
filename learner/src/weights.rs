//! Snapshots of the acting weights: the newest for whoever watches, and the few that leases still ask for.

use bytes::Bytes;
use rit_proto::{
    snapshot::pieces,
    v1::{self, weights_server},
};
use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll, ready},
};
use tokio::sync::watch;
use tokio_stream::{Stream, wrappers::WatchStream};
use tonic::{Request, Response, Status};

/// The acting weights after so many updates.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    /// Updates that made them.
    pub version: u64,
    /// Environment steps collected by then.
    pub env_steps: u64,
    /// Little-endian f32 in the layout's order.
    pub params: Bytes,
}

impl Snapshot {
    /// Copies the acting parameters.
    pub fn new(version: u64, env_steps: u64, params: &[f32]) -> Self {
        Self { version, env_steps, params: params.iter().flat_map(|x| x.to_le_bytes()).collect() }
    }

    /// The parameters again.
    pub fn to_params(&self) -> Vec<f32> {
        let (words, _) = self.params.as_chunks::<4>();
        words.iter().map(|&word| f32::from_le_bytes(word)).collect()
    }

    fn pieces(&self) -> Pieces {
        Box::new(pieces(self.version, self.params.clone()))
    }
}

/// Where the trainer puts snapshots and everybody else finds them.
#[derive(Debug)]
pub struct WeightsBoard {
    newest: watch::Sender<Arc<Snapshot>>,
    kept: Mutex<VecDeque<Arc<Snapshot>>>,
    keep: usize,
}

impl WeightsBoard {
    /// A board with its newest snapshot. The oldest version that a lease can ask for is `policy_lag` updates
    /// behind the newest.
    pub fn new(newest: Snapshot, policy_lag: usize) -> Self {
        let newest = Arc::new(newest);
        let kept = Mutex::new(VecDeque::from([Arc::clone(&newest)]));
        Self { newest: watch::Sender::new(newest), kept, keep: policy_lag + 1 }
    }

    /// All that leases can ask for, oldest first.
    pub fn all_kept(&self) -> Vec<Arc<Snapshot>> {
        self.kept().iter().map(Arc::clone).collect()
    }

    /// Puts up a newer snapshot.
    pub fn publish(&self, snapshot: Snapshot) {
        let snapshot = Arc::new(snapshot);
        let mut kept = self.kept();
        kept.push_back(Arc::clone(&snapshot));
        while kept.len() > self.keep {
            kept.pop_front();
        }
        self.newest.send_replace(snapshot);
    }

    /// The newest snapshot.
    pub fn newest(&self) -> Arc<Snapshot> {
        Arc::clone(&self.newest.borrow())
    }

    /// The snapshot of a version, if a lease can still ask for it.
    pub fn get(&self, version: u64) -> Option<Arc<Snapshot>> {
        self.kept().iter().find(|snapshot| snapshot.version == version).map(Arc::clone)
    }

    fn kept(&self) -> MutexGuard<'_, VecDeque<Arc<Snapshot>>> {
        // Nothing that could panic happens under the lock; what it guards is whole in any case.
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// `rit.v1.Weights`.
#[derive(Clone, Debug)]
pub struct WeightsService(pub Arc<WeightsBoard>);

/// What is left to send of a snapshot.
type Pieces = Box<dyn Iterator<Item = v1::SnapshotPiece> + Send>;

/// Each newest snapshot, piece by piece. One that is begun is sent to its end.
struct NewestInPieces {
    snapshots: WatchStream<Arc<Snapshot>>,
    rest: Pieces,
}

impl Stream for NewestInPieces {
    type Item = Result<v1::SnapshotPiece, Status>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        loop {
            if let Some(piece) = self.rest.next() {
                return Poll::Ready(Some(Ok(piece)));
            }
            match ready!(Pin::new(&mut self.snapshots).poll_next(cx)) {
                Some(snapshot) => self.rest = snapshot.pieces(),
                None => return Poll::Ready(None),
            }
        }
    }
}

#[tonic::async_trait]
impl weights_server::Weights for WeightsService {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::SnapshotPiece, Status>> + Send>>;
    type GetStream = Self::WatchStream;

    async fn watch(&self, _: Request<v1::WatchRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let snapshots = WatchStream::new(self.0.newest.subscribe());
        Ok(Response::new(Box::pin(NewestInPieces { snapshots, rest: Box::new(std::iter::empty()) })))
    }

    async fn get(&self, request: Request<v1::GetRequest>) -> Result<Response<Self::GetStream>, Status> {
        let version = request.into_inner().version;
        let newest = self.0.newest().version;
        let snapshot = self.0.get(version);
        let gone = || Status::not_found(format!("weights {version} are not kept; the newest are {newest}"));
        let snapshot = snapshot.ok_or_else(gone)?;
        Ok(Response::new(Box::pin(tokio_stream::iter(snapshot.pieces().map(Ok)))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rit_proto::snapshot::{Assembly, PIECE_BYTES};
    use tokio_stream::StreamExt as _;
    use weights_server::Weights as _;

    fn snapshot(version: u64) -> Snapshot {
        Snapshot::new(version, 10 * version, &[version as f32, -0.5])
    }

    #[tokio::test]
    async fn who_comes_late_gets_the_newest_and_who_is_slow_skips() {
        let board = Arc::new(WeightsBoard::new(snapshot(0), 1));
        board.publish(snapshot(1));
        let service = WeightsService(Arc::clone(&board));
        let mut late = service.watch(Request::new(v1::WatchRequest {})).await.unwrap().into_inner();
        assert_eq!(late.next().await.unwrap().unwrap().version, 1);
        for version in 2..=5 {
            board.publish(snapshot(version));
        }
        let next = late.next().await.unwrap().unwrap();
        assert_eq!((next.version, next.data), (5, snapshot(5).params));
        assert_eq!(board.newest().to_params(), [5.0, -0.5]);
    }

    #[tokio::test]
    async fn what_a_lease_can_ask_for_is_kept() {
        let board = Arc::new(WeightsBoard::new(snapshot(0), 1));
        for version in 1..=5 {
            board.publish(snapshot(version));
        }
        let service = WeightsService(board);
        let get = async |version| service.get(Request::new(v1::GetRequest { version })).await;
        for version in [4, 5] {
            let pieces = get(version).await.unwrap().into_inner().collect::<Vec<_>>().await;
            assert_eq!((pieces.len(), pieces[0].as_ref().unwrap().version), (1, version));
        }
        assert_eq!(get(3).await.err().unwrap().code(), tonic::Code::NotFound);
    }

    #[tokio::test]
    async fn a_snapshot_that_is_begun_is_sent_to_its_end_before_a_newer_one() {
        let large = |version: u64| Snapshot::new(version, 0, &vec![version as f32; PIECE_BYTES / 2]);
        let board = Arc::new(WeightsBoard::new(large(0), 1));
        let service = WeightsService(Arc::clone(&board));
        let mut stream = service.watch(Request::new(v1::WatchRequest {})).await.unwrap().into_inner();
        let mut assembly = Assembly::new(2 * PIECE_BYTES);
        for version in [0, 5] {
            let first = stream.next().await.unwrap().unwrap();
            assert_eq!(assembly.push(first), Ok(None));
            (1..=5).for_each(|newer| board.publish(large(newer)));
            let second = stream.next().await.unwrap().unwrap();
            assert_eq!(assembly.push(second).unwrap().unwrap().params, large(version).params);
        }
    }
}
