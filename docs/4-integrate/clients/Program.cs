// A whole fraction with HttpClient, against a running Tidegate: prepare, learn, reference, arm, deliver, stop, fetch.
//
//   TIDEGATE_URL=https://gating.example TPS_KEY=tg_... Program PLAN.dcm CALIBRATION.json RECORDING SECONDS FOLDER
//
// Written for .NET 8 and for Mono (mcs -r:System.Net.Http -r:System.Runtime.Serialization -r:System.Xml -r:System.Xml.Linq).
// Certificates are verified by the system's store: put the site's authority there; never switch the check off.
// Exit code 0: delivered. Anything else: the beam was held and the session stopped, and the last line says why.

using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Net;
using System.Net.Http;
using System.Net.Http.Headers;
using System.Runtime.Serialization.Json;
using System.Text;
using System.Threading;
using System.Threading.Tasks;
using System.Xml;
using System.Xml.Linq;

/// <summary>The service refused; Code is stable, and what a program decides by.</summary>
public sealed class ProblemException : Exception
{
    public readonly int Status;
    public readonly string Code;

    public ProblemException(int status, string code, string detail)
        : base(status + " " + code + ": " + detail)
    {
        Status = status;
        Code = code;
    }
}

/// <summary>The calls of a fraction. What could lead to a beam is sent once; what takes it away, until it is answered.</summary>
public sealed class Tidegate : IDisposable
{
    private static readonly int[] Passing = { 429, 502, 503, 504 };
    private const int Attempts = 4;
    private const long MostBytes = 16L * 1024 * 1024;

    private readonly HttpClient http;
    private readonly HttpClient stream;
    private readonly string api;

    public Tidegate(string address, string key)
    {
        Uri uri = new Uri(address);
        if (uri.Scheme != "https" && !uri.IsLoopback)
            throw new ArgumentException("the address must be https: a key over plain http can be read by others");
        api = address.TrimEnd('/') + "/api/v1";
        http = Made(key, TimeSpan.FromSeconds(15));
        stream = Made(key, Timeout.InfiniteTimeSpan);
    }

    private static HttpClient Made(string key, TimeSpan timeout)
    {
        HttpClientHandler handler = new HttpClientHandler { AllowAutoRedirect = false, UseCookies = false };
        HttpClient made = new HttpClient(handler) { Timeout = timeout, MaxResponseContentBufferSize = MostBytes };
        made.DefaultRequestHeaders.Authorization = new AuthenticationHeaderValue("Bearer", key);
        return made;
    }

    public void Dispose()
    {
        http.Dispose();
        stream.Dispose();
    }

    public Task<XElement> Read(string path)
    {
        return Send(HttpMethod.Get, path, null, null, null, true);
    }

    /// <summary>Create something: once, however often it is asked for with this Idempotency-Key.</summary>
    public Task<XElement> Make(string path, byte[] body, string mediaType, string idempotencyKey)
    {
        return Send(HttpMethod.Post, path, body, mediaType, idempotencyKey, true);
    }

    /// <summary>Ask for what could lead to a beam: once. Where no answer came, read the session.</summary>
    public Task<XElement> Do(string path, string json)
    {
        return Send(HttpMethod.Post, path, Encoding.UTF8.GetBytes(json), "application/json", null, false);
    }

    /// <summary>Ask for what takes the beam away, until somebody answers.</summary>
    public Task<XElement> TakeAway(string path, string json)
    {
        return Send(HttpMethod.Post, path, Encoding.UTF8.GetBytes(json), "application/json", null, true);
    }

    private async Task<XElement> Send(
        HttpMethod method, string path, byte[] body, string mediaType, string idempotencyKey, bool isRepeatable)
    {
        for (int attempt = 1; ; attempt++)
        {
            bool isLast = !isRepeatable || attempt == Attempts;
            TimeSpan wait = TimeSpan.FromMilliseconds(200 << attempt);
            try
            {
                using (HttpRequestMessage request = Request(method, path, body, mediaType, idempotencyKey))
                using (HttpResponseMessage answer = await http.SendAsync(request))
                {
                    string text = await answer.Content.ReadAsStringAsync();
                    if (answer.IsSuccessStatusCode) return Parsed(text);
                    if (isLast || !Passing.Contains((int)answer.StatusCode)) throw Problem(answer, text);
                    RetryConditionHeaderValue told = answer.Headers.RetryAfter;
                    if (told != null && told.Delta.HasValue) wait = told.Delta.Value;
                    if (wait > TimeSpan.FromSeconds(30)) throw Problem(answer, text);
                }
            }
            catch (HttpRequestException)
            {
                if (isLast) throw;
            }
            catch (TaskCanceledException)
            {
                if (isLast) throw;
            }
            await Task.Delay(wait);
        }
    }

    private HttpRequestMessage Request(HttpMethod method, string path, byte[] body, string mediaType, string key)
    {
        HttpRequestMessage request = new HttpRequestMessage(method, api + path);
        if (key != null) request.Headers.Add("Idempotency-Key", key);
        if (body == null) return request;
        request.Content = new ByteArrayContent(body);
        request.Content.Headers.ContentType = new MediaTypeHeaderValue(mediaType);
        return request;
    }

    /// <summary>Follow the live stream until `see` has seen enough; false where the stream broke before.</summary>
    public async Task<bool> Live(Func<XElement, bool> see)
    {
        using (HttpRequestMessage request = Request(HttpMethod.Get, "/live/events?form=thin", null, null, null))
        using (HttpResponseMessage answer = await stream.SendAsync(request, HttpCompletionOption.ResponseHeadersRead))
        {
            if (!answer.IsSuccessStatusCode) throw Problem(answer, await answer.Content.ReadAsStringAsync());
            using (StreamReader lines = new StreamReader(await answer.Content.ReadAsStreamAsync(), Encoding.UTF8))
            {
                for (;;)
                {
                    Task<string> reading = lines.ReadLineAsync();
                    // Something comes twice a second even where nothing runs: silence is a broken stream.
                    if (await Task.WhenAny(reading, Task.Delay(5000)) != reading) return false;
                    string line = await reading;
                    if (line == null) return false;
                    if (line.StartsWith("data: ", StringComparison.Ordinal) && see(Parsed(line.Substring(6)))) return true;
                }
            }
        }
    }

    /// <summary>Write an answer to a file: the whole of it, or no file at all.</summary>
    public async Task Download(string path, string file)
    {
        string draft = file + ".part";
        try
        {
            using (HttpRequestMessage request = Request(HttpMethod.Get, path, null, null, null))
            using (HttpResponseMessage answer = await stream.SendAsync(request, HttpCompletionOption.ResponseHeadersRead))
            {
                if (!answer.IsSuccessStatusCode) throw Problem(answer, await answer.Content.ReadAsStringAsync());
                using (FileStream to = File.Create(draft)) await answer.Content.CopyToAsync(to);
            }
            File.Delete(file);
            File.Move(draft, file);
        }
        finally
        {
            File.Delete(draft);
        }
    }

    /// <summary>JSON, as elements: an object's members by name, an array's as `item`.</summary>
    private static XElement Parsed(string text)
    {
        if (text.Length == 0) return new XElement("root");
        XmlDictionaryReaderQuotas bounds = new XmlDictionaryReaderQuotas { MaxDepth = 64 };
        using (XmlReader reader = JsonReaderWriterFactory.CreateJsonReader(Encoding.UTF8.GetBytes(text), bounds))
            return XElement.Load(reader);
    }

    private static ProblemException Problem(HttpResponseMessage answer, string text)
    {
        string type = answer.Content.Headers.ContentType == null ? "" : answer.Content.Headers.ContentType.MediaType;
        if (type != "application/problem+json")
            return new ProblemException((int)answer.StatusCode, "http_" + (int)answer.StatusCode, answer.ReasonPhrase);
        XElement problem = Parsed(text);
        return new ProblemException((int)answer.StatusCode, (string)problem.Element("code"), (string)problem.Element("detail"));
    }
}

public static class Program
{
    private static readonly string Who = "{\"operator\": \"Simulated therapist\"}";

    public static int Main(string[] arguments)
    {
        if (arguments.Length != 5)
        {
            Console.Error.WriteLine("usage: Program PLAN.dcm CALIBRATION.json RECORDING SECONDS FOLDER");
            return 2;
        }
        string address = Environment.GetEnvironmentVariable("TIDEGATE_URL");
        string key = Environment.GetEnvironmentVariable("TPS_KEY");  // never an argument: those can be read by everybody
        try
        {
            using (Tidegate tidegate = new Tidegate(address, key)) return Fraction(tidegate, arguments).GetAwaiter().GetResult();
        }
        catch (Exception error)
        {
            Console.Error.WriteLine(error.Message);
            return 1;
        }
    }

    private static async Task<int> Fraction(Tidegate tidegate, string[] arguments)
    {
        string folder = arguments[4], name = Path.GetFileName(folder);
        double seconds = double.Parse(arguments[3], CultureInfo.InvariantCulture);
        Directory.CreateDirectory(folder);
        string plan = Text(await tidegate.Make("/plans", File.ReadAllBytes(arguments[0]), "application/dicom", name + "-plan"), "id");
        string calibration = Text(
            await tidegate.Make("/calibrations", File.ReadAllBytes(arguments[1]), "application/json", name + "-calibration"), "id");
        string wish = "{\"operator\": \"Simulated therapist\", \"fraction_number\": 1, \"calibration_id\": \"" + calibration + "\","
            + " \"source\": {\"kind\": \"recording\", \"path\": \"" + Escaped(arguments[2]) + "\", \"player\": \"reader\"},"
            + " \"window\": {\"signal\": \"whole\", \"lower_mm\": -1.5, \"upper_mm\": 2.0}}";
        XElement prepared = await tidegate.Make(
            "/plans/" + plan + "/sessions", Encoding.UTF8.GetBytes(wish), "application/json", name + "-session");
        string session = "/sessions/" + Text(prepared, "id");
        string outcome;
        try
        {
            outcome = await Deliver(tidegate, session, Text(prepared, "id"), seconds);
        }
        finally
        {
            await Leave(tidegate, session);
        }
        Console.WriteLine(outcome);
        await tidegate.Download(session + "/samples?format=csv", Path.Combine(folder, "samples.csv"));
        Console.WriteLine("samples: " + (File.ReadLines(Path.Combine(folder, "samples.csv")).Count() - 1) + " frames");
        XElement audit = await tidegate.Read("/audit/verify");
        return outcome.StartsWith("delivered", StringComparison.Ordinal) && Text(audit, "is_intact") == "true" ? 0 : 1;
    }

    private static async Task<string> Deliver(Tidegate tidegate, string session, string id, double seconds)
    {
        await tidegate.Do(session + "/start", Who);
        Console.WriteLine("session " + id + " runs");
        for (;;)
        {
            XElement state = await tidegate.Read(session);
            if (Text(state, "measurement_state") == "measuring") break;
            if (Text(state, "status") != "running") return "the session is over: " + Text(state, "status_detail");
            await Task.Delay(500);
        }
        // A person at the page sets the reference, and sees where in the breath it is; no key may.
        while (Text(await tidegate.Read(session), "has_reference") != "true")
        {
            if (Text(await tidegate.Read(session), "status") != "running") return "over before the reference was set";
            await Task.Delay(500);
        }
        while (!await Armed(tidegate, session)) await Task.Delay(500);
        Console.WriteLine("armed: the gate decides");
        return await Count(tidegate, id, seconds);
    }

    /// <summary>Arm once. Refused means not done, and may be asked for again; a lost answer is looked up.
    /// A person who may arm has to be at a visible page of Tidegate.</summary>
    private static async Task<bool> Armed(Tidegate tidegate, string session)
    {
        try
        {
            await tidegate.Do(session + "/arm", Who);
            return true;
        }
        catch (ProblemException problem)
        {
            if (problem.Status != 409 || Text(await tidegate.Read(session), "status") != "running") throw;
            return false;
        }
        catch (HttpRequestException)
        {
            XElement gate = (await tidegate.Read(session)).Element("gate");
            return gate != null && Text(gate, "is_armed") == "true";
        }
    }

    /// <summary>Count beam-on time by the camera's own clock, from one frame to the next.</summary>
    private static async Task<string> Count(Tidegate tidegate, string id, double seconds)
    {
        double on = 0;
        long last = -1;
        bool wasOn = false;
        string outcome = "the stream broke";
        await tidegate.Live(message =>
        {
            if (Text(message, "type") == "idle") { outcome = "the session is over"; return true; }
            if (Text(message, "type") != "sample" || Text(message, "session_id") != id) return false;
            long now = long.Parse(Text(message, "timestamp_us"), CultureInfo.InvariantCulture);
            if (last >= 0 && wasOn) on += (now - last) / 1e6;
            last = now;
            wasOn = Text(message, "line_on") == "true";
            if (on >= seconds) outcome = "delivered " + on.ToString("0.000", CultureInfo.InvariantCulture) + " s";
            else if (Text(message, "gate") == "fault") outcome = "fault " + Text(message, "hold_reason") + ": a person has to acknowledge";
            else if (Text(message, "session_status") != "running") outcome = "the session is over";
            else return false;
            return true;
        });
        return outcome;
    }

    /// <summary>Whatever happened, the beam is held first.</summary>
    private static async Task Leave(Tidegate tidegate, string session)
    {
        try
        {
            await tidegate.TakeAway(session + "/hold", Who);
        }
        catch (ProblemException)
        {
            // It does not run any more: there is nothing to hold.
        }
        try
        {
            await tidegate.TakeAway(session + "/stop", Who);
        }
        catch (ProblemException problem)
        {
            if (problem.Code != "session_state") throw;
        }
    }

    private static string Escaped(string text)
    {
        return text.Replace("\\", "\\\\").Replace("\"", "\\\"");
    }

    private static string Text(XElement around, string name)
    {
        XElement found = around.Element(name);
        return found == null ? "" : found.Value;
    }
}
