//! MAT choosing joint actions, agent after agent, for several running episodes at once.
//!
//! All that does not depend on actions is made at once. Then come the agents: the first of every episode together, then
//! the second, and so on, each given its own token and the keys and values of those before it.

use super::{DecoderBlock, Mat, MultiHead, normalized_sum};
use crate::{
    Rows,
    methods::Actor,
    on_policy::{self, ActorCritic as _, Inputs},
};
use rit_episode::{Policy, Turn};
use rit_nn::{
    View,
    attention::{Group, Visible},
    tape::{Stock, Tape, Var},
};
use std::sync::Arc;

/// A policy of the networks: holds only what acting needs.
pub struct MatActing {
    mat: Arc<Mat>,
    params: Vec<f32>,
    inputs: Inputs,
    places: Places,
    stock: Stock,
    logits: Vec<f32>,
}

/// Which rows choose together, and where their keys and values lie.
#[derive(Default)]
struct Places {
    /// Of each place in the decision order: the turns that have an agent there.
    turns: Vec<Vec<usize>>,
    /// These agents' rows.
    rows: Vec<Vec<usize>>,
    /// Each of these alone, over the rows of its team up to its own.
    groups: Vec<Vec<Group>>,
}

impl MatActing {
    /// Acts with the given acting parameters (see [`on_policy::ActorCritic::acting`]).
    ///
    /// # Panics
    /// When there are not as many as acting needs.
    pub fn new(mat: Arc<Mat>, params: &[f32]) -> Self {
        let mut acting = Self {
            mat,
            params: Vec::new(),
            inputs: Inputs::default(),
            places: Places::default(),
            stock: Stock::default(),
            logits: Vec::new(),
        };
        acting.set_params(params);
        acting
    }

    /// The logits of the last [`Policy::act`], turn after turn, `[agent rows, A]`: each row's given the actions that
    /// were chosen before it.
    pub fn logits(&self) -> &[f32] {
        &self.logits
    }
}

impl Actor for MatActing {
    fn set_params(&mut self, params: &[f32]) {
        assert_eq!(params.len(), self.mat.acting().len(), "the parameters that acting needs");
        self.params.clear();
        self.params.extend_from_slice(params);
    }
}

impl Policy for MatActing {
    fn begin(&mut self, _: usize, _: usize) {}

    fn act(&mut self, turns: &mut [Turn<'_>]) {
        let Self { mat, params, inputs, places, stock, logits } = self;
        inputs.rows.fill_from_turns(turns);
        mat.fill(inputs);
        places.fill(&inputs.rows);
        let n_actions = mat.config.n_actions;
        logits.clear();
        logits.resize(inputs.rows.agent_rows() * n_actions, 0.0);

        let mut tape = Tape::inference(params, std::mem::take(stock));
        let observations = tape.constant(View::dense(&inputs.observations, mat.config.slots.width()));
        let encoded = mat.encode(&mut tape, observations, &inputs.teams);
        let tokens = mat.embed_tokens(&mut tape, &inputs.one_hots);
        let caches: Vec<Cache> =
            mat.decoder.iter().map(|block| Cache::of(block, &mut tape, encoded.rows)).collect();
        for place in 0..places.rows.len() {
            let rows = &places.rows[place];
            let of_place = places.turns[place].iter().map(|&turn| match place {
                0 => 0,
                _ => usize::from(turns[turn].actions[place - 1]) + 1,
            });
            let mut x = pick(&mut tape, tokens, &of_place.collect::<Vec<_>>());
            let own = pick(&mut tape, encoded, rows);
            for (block, cache) in mat.decoder.iter().zip(&caches) {
                x = cache.forward(block, &mut tape, x, own, rows, &places.groups[place]);
            }
            let of_rows = mat.head.forward(&mut tape, x);
            tape.free(x);
            tape.free(own);
            for (at, (&row, &turn)) in rows.iter().zip(&places.turns[place]).enumerate() {
                let of_row = row * n_actions..(row + 1) * n_actions;
                logits[of_row.clone()].copy_from_slice(tape.view(of_rows).row(at));
                let (turn, available) = (&mut turns[turn], &inputs.rows.available[of_row.clone()]);
                turn.actions[place] = on_policy::choose(&logits[of_row], available, turn.exploration);
            }
            tape.free(of_rows);
        }
        *stock = tape.into_stock();
    }
}

impl Places {
    fn fill(&mut self, rows: &Rows) {
        let longest = rows.groups.iter().map(|group| group.queries.len()).max().unwrap_or(0);
        let having = |place: usize| {
            let all = rows.groups.iter().enumerate();
            all.filter(move |(_, group)| group.queries.len() > place)
        };
        let row = |group: &Group, place| group.queries.start + place;
        self.turns = (0..longest).map(|place| having(place).map(|(turn, _)| turn).collect()).collect();
        self.rows =
            (0..longest).map(|place| having(place).map(|(_, group)| row(group, place)).collect()).collect();
        let group = |place: usize| {
            let each = having(place).enumerate();
            each.map(move |(at, (_, group))| Group {
                queries: at..at + 1,
                keys: group.queries.start..row(group, place) + 1,
            })
        };
        self.groups = (0..longest).map(|place| group(place).collect()).collect();
    }
}

/// A block's keys and values of the rows so far, (R, 2e) each.
struct Cache {
    itself: Var,
    cross: Var,
}

impl Cache {
    fn of(block: &DecoderBlock, tape: &mut Tape<'_>, rows: usize) -> Self {
        let mut reserve = |attention: &MultiHead| tape.reserve(rows, 2 * attention.attention.dim);
        Self { itself: reserve(&block.self_attention), cross: reserve(&block.cross_attention) }
    }

    /// The block over one place's rows: `x` and what the encoder made of them, `own`.
    fn forward<'a>(
        &self,
        block: &DecoderBlock,
        tape: &mut Tape<'a>,
        x: Var,
        own: Var,
        rows: &[usize],
        groups: &'a [Group],
    ) -> Var {
        let attended = attend(&block.self_attention, tape, x, x, self.itself, rows, groups);
        let y = normalized_sum(tape, &block.norm1, x, attended);
        tape.free(x);
        let attended = attend(&block.cross_attention, tape, own, y, self.cross, rows, groups);
        tape.free(y);
        let y = normalized_sum(tape, &block.norm2, own, attended);
        let hidden = block.mlp.forward(tape, y);
        let z = normalized_sum(tape, &block.norm3, y, hidden);
        tape.free(y);
        z
    }
}

/// Attention of one place's rows to those of their teams so far, whose keys and values join the `cache`.
fn attend<'a>(
    layer: &MultiHead,
    tape: &mut Tape<'a>,
    queries: Var,
    keys: Var,
    cache: Var,
    rows: &[usize],
    groups: &'a [Group],
) -> Var {
    let new = tape.key_values(&layer.attention, keys);
    tape.write_into(cache, |values, mut cache, _| {
        for (at, &row) in rows.iter().enumerate() {
            cache.row(row).copy_from_slice(values.view(new).row(at));
        }
    });
    tape.free(new);
    let queries = tape.linear(&layer.attention.query, queries);
    let out = tape.attend(&layer.attention, queries, cache, groups, Visible::All);
    tape.free(queries);
    let y = tape.linear(&layer.proj, out);
    tape.free(out);
    y
}

/// y row i = x row `rows[i]`, without a gradient.
fn pick(tape: &mut Tape<'_>, x: Var, rows: &[usize]) -> Var {
    let mut y = tape.take(rows.len() * x.cols);
    for (to, &from) in y.chunks_exact_mut(x.cols).zip(rows) {
        to.copy_from_slice(tape.view(x).row(from));
    }
    tape.push(y, x.cols)
}
