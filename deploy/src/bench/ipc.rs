//! Episode frames through shared memory, end to end: a sender and a receiver on a thread each, as actor and
//! learner have them, beside two plain copies of the same bytes.

use super::{Report, thread_cpu_s};
use crate::failure::Failure;
use bytemuck::Zeroable as _;
use rit_episode::wire::{ALIGNMENT, Frame, Header};
use rit_ipc::{EpisodeReceiver, EpisodeSender, Limits, RunSpace};
use rit_record::cpu_seconds;
use std::{
    hint::{self, black_box},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

/// How long a wait for frames lasts at most.
const WAIT: Duration = Duration::from_millis(100);

/// How long the bare handover is measured at most.
const HANDOVER_AT_MOST: Duration = Duration::from_secs(2);

/// Memory that received frames are copied to in turn, as into replay: larger than the caches.
const REPLAY_BYTES: usize = 256 << 20;

pub(super) fn run(payload_kib: usize, duration: Duration) -> Result<Report, Failure> {
    let payload_len = (payload_kib << 10).next_multiple_of(ALIGNMENT);
    let directory = std::env::temp_dir().join(format!("rit-bench-{}", std::process::id()));
    let space = RunSpace::new(&directory).map_err(Failure::runtime)?;
    let measured = transfer(&space, payload_len, duration);
    space.remove().map_err(Failure::runtime)?;
    let (items, cpu) = measured?;
    let per_item = cpu / items as f64;
    let copies = two_copies_s(payload_len);
    let handover = handover_s(payload_len, duration.min(HANDOVER_AT_MOST));

    let mut report = Report::new();
    report.insert("items_per_cpu_s".into(), (1.0 / per_item).into());
    report.insert("memcpy_share".into(), (copies / per_item).into());
    report.insert("item_cpu_us".into(), (1e6 * per_item).into());
    report.insert("two_memcpys_cpu_us".into(), (1e6 * copies).into());
    report
        .insert("limit".into(), "one thread copies the bytes in, and out to memory of replay's size".into());
    report.insert("handover_share".into(), (handover / per_item).into());
    report.insert("handover_cpu_us".into(), (1e6 * handover).into());
    report
        .insert("handover".into(), "the same two copies, each on a core of its own, and nothing else".into());
    report.insert("payload_bytes".into(), payload_len.into());
    report.insert("items".into(), items.into());
    Ok(report)
}

/// Sends for a while; returns the frames received and the CPU seconds both sides took.
fn transfer(space: &RunSpace, payload_len: usize, duration: Duration) -> Result<(u64, f64), Failure> {
    let mut receiver =
        EpisodeReceiver::create(space, Limits::new(payload_len, 1)).map_err(Failure::runtime)?;
    let stop = AtomicBool::new(false);
    let mut replay = vec![1_u8; (REPLAY_BYTES / payload_len).max(1) * payload_len];
    let (mut received, mut place) = (0, 0);
    thread::scope(|scope| {
        let sending = scope.spawn(|| -> Result<(), Failure> {
            let mut sender = EpisodeSender::open(space, payload_len, WAIT).map_err(Failure::runtime)?;
            let mut frame = Frame { header: Header::zeroed(), payload: vec![7; payload_len] };
            while !stop.load(Ordering::Relaxed) {
                frame.header.episode += 1;
                if sender.send(&frame, &|| stop.load(Ordering::Relaxed)).is_err() {
                    break;
                }
            }
            Ok(())
        });
        let (cpu, begun) = (cpu_seconds(), Instant::now());
        let received = loop {
            while let Some(frame) = receiver.receive().map_err(Failure::runtime)? {
                replay[place..place + payload_len].copy_from_slice(frame.payload());
                place = (place + payload_len) % replay.len();
                received += 1;
            }
            if begun.elapsed() >= duration {
                stop.store(true, Ordering::Relaxed);
                break received;
            }
            receiver.wait(WAIT).map_err(Failure::runtime)?;
        };
        let cpu = cpu_seconds() - cpu;
        sending.join().map_err(|_| Failure::runtime_message("the sending thread panicked"))??;
        Ok((received, cpu))
    })
}

/// CPU seconds of two plain copies of so many bytes: into a slot that is written again and again, and out to
/// the next place of a large memory.
fn two_copies_s(len: usize) -> f64 {
    let (source, mut slot) = (vec![7_u8; len], vec![1_u8; len]);
    let mut replay = vec![1_u8; (REPLAY_BYTES / len).max(1) * len];
    let mut best = f64::INFINITY;
    for _ in 0..3 {
        let begun = thread_cpu_s();
        let mut items = 0;
        for place in replay.chunks_exact_mut(len) {
            slot.copy_from_slice(black_box(&source));
            place.copy_from_slice(black_box(&slot));
            items += 1;
        }
        best = best.min((thread_cpu_s() - begun) / f64::from(items));
    }
    black_box(&replay);
    best
}

/// Seconds that two plain copies of so many bytes take when what one core has written another one reads: through as many
/// slots as a sender has, without anything else. What it takes longer than [`two_copies_s`] no transport can save.
fn handover_s(len: usize, duration: Duration) -> f64 {
    let slots = Limits::new(len, 1).frames_per_sender;
    let slots: Vec<Mutex<Vec<u8>>> = (0..slots).map(|_| Mutex::new(vec![1; len])).collect();
    let (written, read, stop) = (AtomicU64::new(0), AtomicU64::new(0), AtomicBool::new(false));
    let slot = |item: u64| &slots[item as usize % slots.len()];
    // Never contended: the counts say whose turn it is. Copies alone are timed, not the waits between them.
    let timed = |slot: &Mutex<Vec<u8>>, copy: &mut dyn FnMut(&mut [u8])| {
        let mut slot = slot.lock().unwrap_or_else(PoisonError::into_inner);
        let begun = Instant::now();
        copy(&mut slot);
        begun.elapsed()
    };
    thread::scope(|scope| {
        let writing = scope.spawn(|| {
            let (source, mut spent) = (vec![7_u8; len], Duration::ZERO);
            for item in 0.. {
                while item - read.load(Ordering::Acquire) >= slots.len() as u64 {
                    if stop.load(Ordering::Relaxed) {
                        return spent;
                    }
                    hint::spin_loop();
                }
                spent += timed(slot(item), &mut |slot| slot.copy_from_slice(black_box(&source)));
                written.store(item + 1, Ordering::Release);
            }
            spent
        });
        let mut replay = vec![1_u8; (REPLAY_BYTES / len).max(1) * len];
        let (begun, mut spent, mut items) = (Instant::now(), Duration::ZERO, 0);
        for place in (0..replay.len() / len).cycle() {
            if begun.elapsed() >= duration {
                break;
            }
            while written.load(Ordering::Acquire) <= items {
                hint::spin_loop();
            }
            let to = &mut replay[place * len..][..len];
            spent += timed(slot(items), &mut |slot| to.copy_from_slice(black_box(slot)));
            items += 1;
            read.store(items, Ordering::Release);
        }
        stop.store(true, Ordering::Relaxed);
        // Slots that were written and not read: a few of very many.
        let writing = writing.join().unwrap_or_default();
        (spent + writing).as_secs_f64() / items as f64
    })
}
