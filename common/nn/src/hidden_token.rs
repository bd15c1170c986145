//! A transformer's block over entity tokens and one recurrent token per agent (UPDeT): what an agent remembers is a
//! token among those it sees.
//!
//! An agent's tokens are the entities it sees and its hidden token: the block's output for the hidden token one step
//! before, zeros at the first step. Two tokens are queries: the agent's own entity, whose output is the block's output,
//! and the hidden token, whose output is the next hidden token. Only the hidden token is recurrent. Entities' keys and
//! values and the agents' own queries do not depend on it: they are computed for all steps at once before the
//! recurrence. The own queries' attention reads the hidden tokens, so it follows for all steps at once afterwards.

mod attend;

use crate::{
    Accum, Attention, Buffer, LayoutBuilder, Scratch, View, ViewMut, activation,
    attention::{Group, Visible},
    linear, math, matmul,
    post_norm::{PostNorm, PostNormGradients, PostNormState},
    vectorized,
};
use attend::{Tokens, attend, attend_backward};
use std::ops::Range;

/// The block: attention with its output layer, feed-forward, norms after the sums.
#[derive(Clone, Debug)]
pub struct HiddenToken {
    attention: Attention,
    post_norm: PostNorm,
}

/// Where the rows of a batch lie: agents' rows are the groups' queries, time after time, and an agent's own token
/// is the one of the same place among its group's keys.
#[derive(Clone, Copy, Debug)]
pub struct Places<'a> {
    /// Each group's agents (queries) and entities (keys).
    pub groups: &'a [Group],
    /// First group of each time, then how many there are.
    pub group_times: &'a [usize],
    /// First agent row of each time, then how many there are. The rows of a time go on with a prefix of those of the
    /// time before.
    pub agent_times: &'a [usize],
    /// Which of its group's entities each agent sees. Each agent always sees its own hidden token.
    pub visible: Visible<'a>,
}

/// What forward leaves for backward. With R agent rows and E entity rows; what has 2R rows begins with those of
/// hidden tokens.
#[derive(Debug)]
pub struct HiddenTokenState {
    /// Who asks: hidden tokens before, and agents' own x, `[2R, h]`.
    u: Buffer,
    /// `[2R, a]`.
    queries: Buffer,
    /// Keys and ReLU'd values of entities, `[E, 2a]`.
    entities: Buffer,
    /// Keys and ReLU'd values of hidden tokens, `[R, 2a]`.
    hidden: Buffer,
    /// Softmax weights of hidden tokens; the groups' `[heads, queries, keys + 1]` one after another.
    hidden_weights: Buffer,
    /// And of agents' own rows.
    own_weights: Buffer,
    /// `[2R, a]`.
    attended: Buffer,
    post_norm: PostNormState,
}

impl HiddenToken {
    /// Declares `{name}.attention`, `.attention_out`, `.attention_norm`, `.feedforward_hidden`, `.feedforward_out` and
    /// `.feedforward_norm`.
    pub fn new(
        layout: &mut LayoutBuilder,
        name: &str,
        dim: usize,
        attention_dim: usize,
        heads: usize,
        feedforward_dim: usize,
    ) -> Self {
        let attention = Attention::new(layout, &format!("{name}.attention"), dim, attention_dim, heads);
        let post_norm = PostNorm::new(layout, name, attention_dim, dim, feedforward_dim);
        Self { attention, post_norm }
    }

    /// h: columns of x and of the output.
    pub fn dim(&self) -> usize {
        self.post_norm.dim()
    }

    /// Writes what becomes of the agents' own tokens, `own` [R, h], and their hidden tokens after each step, `history`
    /// [R, h], from the entities' `x` (E, h). `before` (rows of the first time, h) are the hidden tokens before the first
    /// time, or zeros. The state's buffers come from `stock`.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn forward(
        &self,
        params: &[f32],
        places: Places<'_>,
        x: View<'_>,
        before: Option<View<'_>>,
        own: &mut [f32],
        history: &mut [f32],
        stock: &mut Scratch,
    ) -> HiddenTokenState {
        let (h, a) = (self.dim(), self.attention.dim);
        let rows = places.rows();
        let mut state = HiddenTokenState {
            u: stock.take(2 * rows * h),
            queries: stock.take(2 * rows * a),
            entities: stock.take(x.rows * 2 * a),
            hidden: stock.take(rows * 2 * a),
            hidden_weights: stock.take(self.weights(places.groups)),
            own_weights: stock.take(self.weights(places.groups)),
            attended: stock.take(2 * rows * a),
            post_norm: self.post_norm.state(2 * rows, stock),
        };
        self.project_entities(params, places, x, &mut state);
        let (mut pairs, mut weights) = (0, 0);
        for time in 0..places.times() {
            let (groups, range) = places.at(time);
            let (done, ahead) = history.split_at_mut(range.start * h);
            let previous = match before {
                _ if time > 0 => Some(View::dense(&done[places.agent_times[time - 1] * h..], h)),
                before => before,
            };
            self.project_hidden(params, range.clone(), previous, &mut state);
            let part = weights..weights + self.weights(groups);
            let HiddenTokenState { queries, entities, hidden, hidden_weights, attended, .. } = &mut state;
            let tokens = Tokens { queries: View::dense(&queries[..rows * a], a), entities, hidden };
            let out = ViewMut::dense(&mut attended[..rows * a], a);
            let weights_here = &mut hidden_weights[part.clone()];
            attend(tokens, groups, places.visible_from(pairs), weights_here, out, self.head_dim());
            weights = part.end;
            pairs += groups.iter().map(Group::pairs).sum::<usize>();
            let out = ViewMut::dense(&mut ahead[..range.len() * h], h);
            self.finish(params, range, &mut state, out);
        }
        let HiddenTokenState { queries, entities, hidden, own_weights, attended, .. } = &mut state;
        let tokens = Tokens { queries: View::dense(&queries[rows * a..], a), entities, hidden };
        let out = ViewMut::dense(&mut attended[rows * a..], a);
        attend(tokens, places.groups, places.visible, own_weights, out, self.head_dim());
        self.finish(params, rows..2 * rows, &mut state, ViewMut::dense(own, h));
        state
    }

    /// Takes `d_own` (R, h), the gradient by the agents' own rows. Writes `d_x` (E, h) and adds to the parameters'
    /// gradients. Hidden tokens before the first time are taken as constant.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    pub fn backward(
        &self,
        params: &[f32],
        places: Places<'_>,
        x: View<'_>,
        state: &HiddenTokenState,
        d_own: View<'_>,
        d_x: ViewMut<'_>,
        grads: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let mut d = self.gradients(places, x.rows, state, scratch);
        self.backward_own(params, places, state, d_own, &mut d, grads);
        let mut d_out = scratch.take_zeros(places.rows() * self.dim());
        self.backward_recurrence(params, places, state, &mut d_out, &mut d, grads);
        scratch.give(d_out);
        let attended = View::dense(&state.attended, self.attention.dim);
        self.post_norm.backward_params(attended, &state.post_norm, &d.post_norm, grads);
        self.backward_projections(params, places, x, state, &mut d, d_x, grads);
        d.give(scratch);
    }

    /// Room for the gradients, those that are only added to being zeros.
    fn gradients(
        &self,
        places: Places<'_>,
        entities: usize,
        state: &HiddenTokenState,
        scratch: &mut Scratch,
    ) -> HiddenTokenGradients {
        let (h, a, rows) = (self.dim(), self.attention.dim, places.rows());
        HiddenTokenGradients {
            u: scratch.take(2 * rows * h),
            queries: scratch.take(2 * rows * a),
            attended: scratch.take(2 * rows * a),
            entities: scratch.take_zeros(entities * 2 * a),
            hidden: scratch.take_zeros(rows * 2 * a),
            post_norm: self.post_norm.gradients(&state.post_norm, scratch),
        }
    }

    /// The agents' own rows of all times: writes their `d.u`, `d.queries` and `d.attended`, and adds to `d.entities` and
    /// `d.hidden`.
    fn backward_own(
        &self,
        params: &[f32],
        places: Places<'_>,
        state: &HiddenTokenState,
        d_own: View<'_>,
        d: &mut HiddenTokenGradients,
        grads: &mut [f32],
    ) {
        let (h, a, rows) = (self.dim(), self.attention.dim, places.rows());
        let HiddenTokenState { queries, entities, hidden, own_weights, post_norm, .. } = state;
        let d_attended = &mut d.attended[rows * a..];
        self.post_norm.backward(
            params,
            rows..2 * rows,
            post_norm,
            &mut d.post_norm,
            d_own,
            ViewMut::dense(&mut d.u[rows * h..], h),
            ViewMut::dense(d_attended, a),
            grads,
        );
        attend_backward(
            Tokens { queries: View::dense(&queries[rows * a..], a), entities, hidden },
            places.groups,
            own_weights,
            View::dense(d_attended, a),
            [&mut d.queries[rows * a..], &mut d.entities, &mut d.hidden],
            self.head_dim(),
        );
    }

    /// Hidden tokens, from the last time to the first: writes their `d.u`, `d.queries` and `d.attended`, and adds to
    /// `d.entities` and `d.hidden`. `d_out` `[R, h]` collects the gradient by what became of them, zeros at first.
    fn backward_recurrence(
        &self,
        params: &[f32],
        places: Places<'_>,
        state: &HiddenTokenState,
        d_out: &mut [f32],
        d: &mut HiddenTokenGradients,
        grads: &mut [f32],
    ) {
        let (h, a, rows) = (self.dim(), self.attention.dim, places.rows());
        let HiddenTokenState { queries, entities, hidden, hidden_weights, post_norm, .. } = state;
        let (d_u, d_queries) = (&mut d.u[..rows * h], &mut d.queries[..rows * a]);
        let d_attended = &mut d.attended[..rows * a];
        let tokens = Tokens { queries: View::dense(&queries[..rows * a], a), entities, hidden };
        let mut weights = hidden_weights.len();
        for time in (0..places.times()).rev() {
            let (groups, range) = places.at(time);
            let part = weights - self.weights(groups)..weights;
            weights = part.start;
            self.post_norm.backward(
                params,
                range.clone(),
                post_norm,
                &mut d.post_norm,
                View::dense(d_out, h).rows(range.clone()),
                ViewMut::dense(d_u, h).rows(range.clone()),
                ViewMut::dense(d_attended, a).rows(range.clone()),
                grads,
            );
            let d_tokens: [&mut [f32]; 3] = [&mut *d_queries, &mut d.entities, &mut d.hidden];
            let d_attended = View::dense(d_attended, a);
            attend_backward(tokens, groups, &hidden_weights[part], d_attended, d_tokens, self.head_dim());
            let of_hidden = ViewMut::dense(&mut d.hidden, 2 * a).rows(range.clone());
            let values = View::dense(hidden, 2 * a).rows(range.clone()).columns(a..2 * a);
            activation::relu_backward(values, of_hidden.columns(a..2 * a));
            if time > 0 {
                let d_queries = View::dense(d_queries, a).rows(range.clone());
                let d_hidden = View::dense(&d.hidden, 2 * a).rows(range.clone());
                let first = places.agent_times[time - 1];
                let mut d_previous = ViewMut::dense(d_out, h).rows(first..first + range.len());
                linear::add(d_previous.reborrow(), View::dense(d_u, h).rows(range));
                let weight = self.attention.query.weight(params);
                matmul::dy_w(d_queries, weight, d_previous.reborrow(), Accum::Add);
                matmul::dy_w(d_hidden, self.attention.key_value.weight(params), d_previous, Accum::Add);
            }
        }
    }

    /// From the gradients by queries, keys and values to those by their layers and, written, by `x`.
    #[allow(clippy::too_many_arguments, reason = "a matrix and its companions, each named")]
    fn backward_projections(
        &self,
        params: &[f32],
        places: Places<'_>,
        x: View<'_>,
        state: &HiddenTokenState,
        d: &mut HiddenTokenGradients,
        mut d_x: ViewMut<'_>,
        grads: &mut [f32],
    ) {
        let (h, a, rows) = (self.dim(), self.attention.dim, places.rows());
        let u = View::dense(&state.u, h);
        let Attention { query, key_value, .. } = &self.attention;
        query.backward_params(u, View::dense(&d.queries, a), grads);
        let values = View::dense(&state.entities, 2 * a).columns(a..2 * a);
        activation::relu_backward(values, ViewMut::dense(&mut d.entities, 2 * a).columns(a..2 * a));
        for (x, d) in [(x, &d.entities), (u.rows(0..rows), &d.hidden)] {
            let d = View::dense(d, 2 * a);
            matmul::dyt_x(d, x, key_value.weight_mut(grads), Accum::Add);
            // The key's bias has no gradient, because softmax cancels it: see `Attention::project_keys`.
            linear::add_column_sums(d.columns(a..2 * a), &mut key_value.bias_mut(grads)[a..]);
        }
        let d_entities = View::dense(&d.entities, 2 * a);
        matmul::dy_w(d_entities, key_value.weight(params), d_x.reborrow(), Accum::Replace);
        // An agent's own x is both the query and the residual that the attention's output is added to.
        let d_queries = View::dense(&d.queries[rows * a..], a);
        let d_own_u = &mut d.u[rows * h..];
        matmul::dy_w(d_queries, query.weight(params), ViewMut::dense(d_own_u, h), Accum::Add);
        add_to_agents(places.groups, View::dense(d_own_u, h), d_x);
    }

    /// Entities' keys and values, agents' own rows and their queries.
    fn project_entities(
        &self,
        params: &[f32],
        places: Places<'_>,
        x: View<'_>,
        state: &mut HiddenTokenState,
    ) {
        let (h, a, rows) = (self.dim(), self.attention.dim, places.rows());
        let u = &mut state.u;
        for group in places.groups {
            for (agent, entity) in group.queries.clone().zip(group.keys.clone()) {
                u[(rows + agent) * h..][..h].copy_from_slice(x.row(entity));
            }
        }
        let queries = ViewMut::dense(&mut state.queries[rows * a..], a);
        self.attention.query.forward(params, View::dense(&u[rows * h..], h), queries);
        self.attention.project_keys(params, x, ViewMut::dense(&mut state.entities, 2 * a));
    }

    /// These rows' hidden tokens, zeros or the first of `previous`, and their queries, keys and values.
    fn project_hidden(
        &self,
        params: &[f32],
        rows: Range<usize>,
        previous: Option<View<'_>>,
        state: &mut HiddenTokenState,
    ) {
        let (h, a) = (self.dim(), self.attention.dim);
        let u = &mut state.u[rows.start * h..rows.end * h];
        for (row, u) in u.chunks_exact_mut(h).enumerate() {
            match previous {
                Some(previous) => u.copy_from_slice(previous.row(row)),
                None => u.fill(0.0),
            }
        }
        let u = View::dense(u, h);
        self.attention.query.forward(params, u, ViewMut::dense(&mut state.queries, a).rows(rows.clone()));
        self.attention.project_keys(params, u, ViewMut::dense(&mut state.hidden, 2 * a).rows(rows));
    }

    /// All that follows the attention, of these of the 2R rows.
    fn finish(&self, params: &[f32], rows: Range<usize>, state: &mut HiddenTokenState, out: ViewMut<'_>) {
        let HiddenTokenState { u, attended, post_norm, .. } = state;
        let (u, attended) = (View::dense(u, self.dim()), View::dense(attended, self.attention.dim));
        let (u, attended) = (u.rows(rows.clone()), attended.rows(rows.clone()));
        self.post_norm.forward(params, rows, u, attended, post_norm, out);
    }

    /// Softmax weights of these groups.
    fn weights(&self, groups: &[Group]) -> usize {
        let of_group = |group: &Group| group.queries.len() * (group.keys.len() + 1);
        self.attention.heads * groups.iter().map(of_group).sum::<usize>()
    }

    fn head_dim(&self) -> usize {
        self.attention.dim / self.attention.heads
    }
}

/// Gradients by parts of [`HiddenTokenState`], in its rows.
struct HiddenTokenGradients {
    u: Buffer,
    queries: Buffer,
    attended: Buffer,
    entities: Buffer,
    hidden: Buffer,
    post_norm: PostNormGradients,
}

impl HiddenTokenGradients {
    /// Gives all buffers back.
    fn give(self, scratch: &mut Scratch) {
        let Self { u, queries, attended, entities, hidden, post_norm } = self;
        for buffer in [u, queries, attended, entities, hidden] {
            scratch.give(buffer);
        }
        post_norm.give(scratch);
    }
}

impl HiddenTokenState {
    /// Gives all buffers back.
    pub fn give(self, stock: &mut Scratch) {
        let Self { u, queries, entities, hidden, hidden_weights, own_weights, attended, post_norm } = self;
        for buffer in [u, queries, entities, hidden, hidden_weights, own_weights, attended] {
            stock.give(buffer);
        }
        post_norm.give(stock);
    }
}

impl<'a> Places<'a> {
    /// Agent rows, R.
    pub(crate) fn rows(&self) -> usize {
        self.agent_times.last().copied().unwrap_or(0)
    }

    fn times(&self) -> usize {
        self.agent_times.len().saturating_sub(1)
    }

    /// A time's groups and agent rows.
    fn at(&self, time: usize) -> (&'a [Group], Range<usize>) {
        let groups = &self.groups[self.group_times[time]..self.group_times[time + 1]];
        (groups, self.agent_times[time]..self.agent_times[time + 1])
    }

    /// What is seen from so many query–key pairs on.
    fn visible_from(&self, pairs: usize) -> Visible<'a> {
        match self.visible {
            Visible::All => Visible::All,
            Visible::Where(flags) => Visible::Where(&flags[pairs..]),
        }
    }
}

vectorized! {
    /// Adds agents' rows to those of the entities they are.
    fn add_to_agents<'a>(groups: &'a [Group], of_agents: View<'a>, d_x: ViewMut<'a>) {
        for group in groups {
            for (agent, entity) in group.queries.clone().zip(group.keys.clone()) {
                math::add_scaled(d_x.row(entity), 1.0, of_agents.row(agent));
            }
        }
    }
}

#[cfg(test)]
mod tests;
